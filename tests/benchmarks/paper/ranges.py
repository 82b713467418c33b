# SPDX-License-Identifier: BSD-3-Clause
"""Largest distances at which patterns are found (Tables II and V), and the part of a wall that is covered (V-C)."""

from collections.abc import Callable
from itertools import pairwise

import cv2
import numpy as np

from camera_node.detection.detector import Detector
from camera_node.foundation.arrays import Grey
from camera_node.geometry.lens import Lens
from camera_node.sensor_model.operational_space import PAPER_D, Pattern, farthest_distance, operational_space
from camera_node.sensor_model.visibility import detection_range, is_detected
from tests.benchmarks.detector.pictures import dead_leaves, expose
from tests.benchmarks.paper import published
from tests.benchmarks.paper.reference import PaperDetector
from tests.benchmarks.paper.report import Section, name_of, table
from tests.benchmarks.paper.scenes import BRIGHT, DARK, View, roundel, trace_print

Search = Callable[[Grey], int]  # the number of patterns that are found in an image
SIZES_PX = (16.0, 14.0, 13.0, 12.0, 11.0, 10.0, 9.0, 8.0, 7.0, 6.0)
RECALL, NOISE, SLANT = 0.95, 3.0, 0.2


def searches() -> dict[str, Search]:
    """By name: ours, the paper's method in our program, and the paper's detector at the best threshold."""
    return {
        "ours": lambda image: len(Detector(min_diameter_px=6).detect(image)),
        "paper's search": lambda image: len(Detector(detector="paper", min_diameter_px=6).detect(image)),
        "reference": lambda image: len(PaperDetector((DARK + BRIGHT) / 2).detect(image)),
    }


def largest_distances(lens: Lens, pattern: Pattern, views: int) -> dict[str, float]:
    """The largest distance, metres, up to which each search finds 95 % of the views; nan where it finds none.

    Views are near the optical axis, slanted by up to 0.2 rad, on clutter.
    """
    sheet, found = roundel(pattern), {name: [] for name in searches()}
    for size in SIZES_PX:
        distance = pattern.d_o * min(lens.fx, lens.fy) / size
        counts = dict.fromkeys(found, 0)
        for seed in range(views):
            rng = np.random.default_rng(seed)
            u, v = np.array([lens.cx, lens.cy]) + rng.uniform(-20, 20, 2)
            view = View(lens, (u, v), distance, float(rng.uniform(0, SLANT)), float(rng.uniform(0, 6.28)))
            image = trace_print(view, sheet, rng).expose(NOISE, rng)
            for name, search in searches().items():
                counts[name] += search(image) == 1
        for name, count in counts.items():
            found[name].append((distance, count >= RECALL * views))
        if not any(ok for results in found.values() for _, ok in results[-2:]):
            break
    return {name: _last_found(results) for name, results in found.items()}


def count_false(images: int = 20) -> dict[str, int]:
    """The number of patterns that each search finds in images, 640x480, of clutter without any."""
    counts = dict.fromkeys(searches(), 0)
    for seed in range(images):
        rng = np.random.default_rng(seed)
        light = cv2.GaussianBlur(dead_leaves((480, 640), rng), (0, 0), 0.7)
        image = expose(np.asarray(light, float), NOISE, rng)
        for name, search in searches().items():
            counts[name] += search(image)
    return counts


def _last_found(results: list[tuple[float, bool]]) -> float:
    """The largest of the rising distances at which it and the one before are found."""
    both = [far for (_, before), (far, here) in pairwise(results) if before and here]
    return max(both, default=float("nan"))


def measure_range(views: int = 12) -> Section:
    """Table V: the range of each pattern, and that of Section V-A as L_max of Table II."""
    rows, worse = [], []
    for resolution in published.RESOLUTIONS:
        lens = published.paper_lens(resolution)
        known = dict(zip(published.PATTERNS, published.TABLE_5[resolution], strict=True))
        patterns = {"14 cm": published.PATTERN, **published.PATTERNS}
        for name, pattern in patterns.items():
            paper = known.get(name, published.TABLE_2[resolution].l_max)
            measured = largest_distances(lens, pattern, views)
            if not measured["ours"] > paper:
                worse.append(f"{name} at {name_of(resolution)}")
            predicted = farthest_distance(lens, pattern.d_o, PAPER_D), detection_range(lens, pattern)[1]
            rows.append(
                (
                    f"{name_of(resolution)}, {name}",
                    *(f"{x:.2f}" for x in (paper, *measured.values(), *predicted)),
                )
            )
    headings = (
        "resolution, pattern",
        "paper, measured",
        "ours (sim.)",
        "paper's search, our fit (sim.)",
        "reference (sim.)",
        "model, D = 11",
        "model, our D",
    )
    return Section(
        "Table V and L_max of Table II: range by size of the pattern, metres",
        "Largest distance at which 95 % are found in a new image; in steps of a pixel of the pattern's size. Simulated "
        "is the paper's camera without its unknown focus (blur 0.7 px, noise 3), on clutter. The reference is given "
        "the best threshold, and the light is even. Then it finds smaller patterns than ours, whose local thresholds "
        "need more of the white margin. The columns of the model are v_max of Section IV with the paper's D, and with "
        "ours.",
        [
            table(headings, rows),
            table(
                ("20 images without a pattern", *searches()), [("patterns found", *count_false().values())]
            ),
        ],
        worse,
    )


def measure_wall(step_m: float = 0.02) -> Section:
    """Section V-C: which part of a wall is covered."""
    lens, pattern = published.paper_lens(published.WALL_RESOLUTION), published.PATTERN
    space = operational_space(lens, pattern.d_o)
    tops = {y: (_reach(lens, (y, None), step_m), z) for y, z in published.WALL_TOP.items()}
    left, right = (np.array(_reach(lens, (None, 0.0), sign * step_m)) for sign in (-1, 1))
    width, height = right - left, tops[0.0][0] - np.array(_reach(lens, (0.0, None), -step_m))
    base = published.WALL_M * np.array([lens.width / lens.fx, lens.height / lens.fy]) - 2 * pattern.d_o
    rows = [
        ("width at z = 0", published.WALL_WIDTH, *(f"{x:.2f}" for x in (*width, base[0]))),
        ("height at y = 0", published.WALL_HEIGHT, *(f"{x:.2f}" for x in (*height, base[1]))),
        *(
            (f"largest z at y = {y:g}", z, *(f"{x:.2f}" for x in (*found, base[1] / 2)))
            for y, (found, z) in tops.items()
        ),
    ]
    worse = [row[0] for row in rows if float(row[2]) < float(row[1])]
    return Section(
        "Section V-C: operational space at a wall, 3 m away, 480x360, metres",
        "The pattern is parallel to the wall. Simulated: barrel distortion k1 = -0.30 is an assumption that gives "
        "about "
        "the paper's 4 m; the paper's camera was aimed by hand. The width is a property of that "
        "lens: the pattern is found up to the border of the image, with a tenth of it cut off. The last "
        f"column is Section IV (corrected, without distortion): v_max {space.v_max:.2f} m with D = 11.",
        [table(("", "paper, measured", "ours (sim.)", "our model", "Section IV"), rows)],
        worse,
    )


def _reach(lens: Lens, line: tuple[float | None, float | None], step_m: float) -> tuple[float, float]:
    """How far along a line of the wall, found and predicted; None is the free coordinate, the step gives its sign."""
    along = np.sign(step_m) * np.arange(0.5, 3.0, abs(step_m))
    y, z = (along if fixed is None else np.full(len(along), fixed) for fixed in line)
    points = np.column_stack([y, -z, np.full(len(along), published.WALL_M)])
    normal = np.array([0.0, 0.0, -1.0])
    towards = np.tile(normal, (len(points), 1))
    predicted = along[is_detected(lens, published.PATTERN, points, towards)][-1]
    near = np.flatnonzero(np.abs(along - predicted) < 0.3)
    found = [along[k] for k in near if _is_found(lens, points[k], normal)]
    return (found[-1] if found else float("nan")), float(predicted)


def _is_found(lens: Lens, point: np.ndarray, normal: np.ndarray) -> bool:
    rng = np.random.default_rng(7)
    view = View.at(lens, point, normal)
    picture = trace_print(view, roundel(published.PATTERN), rng)
    off = Detector().detect(picture.expose(NOISE, rng)).uv - picture.lens.project(view.position)
    return len(off) == 1 and float(np.linalg.norm(off)) < 2.0
