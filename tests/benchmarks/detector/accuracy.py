# SPDX-License-Identifier: BSD-3-Clause
"""Errors of centre and distance over the Cramer-Rao bound, and consistency of the reported covariance.

The detector does not know the lens, so its centre is compared with the bound for an unknown lens. A pose is located
with the lens; the centre of its ellipse is compared with the bound for a known lens.
"""

from dataclasses import dataclass, replace

import numpy as np
from rich.console import Console

from camera_node.detection.disc_pose import DiscPose, locate
from camera_node.foundation.arrays import Array
from tests.benchmarks.detector.bound import Bound, bound
from tests.benchmarks.detector.cells import Cell, cells, views
from tests.benchmarks.detector.pictures import expose
from tests.benchmarks.detector.table import Run, Verdict, table
from tests.camera_node.tracing import Sight, ellipse_of, trace

CENTRE, CENTRE_WORST, DISTANCE, BIAS = 1.15, 1.3, 1.5, 5e-4


@dataclass(frozen=True)
class Errors:
    """The results of a cell: means over all detections; ratios are over the bound."""

    found: float
    centre: float  # of the located pose's ellipse
    detected: float  # over the bound for an unknown lens
    chi2: float  # squared Mahalanobis error of the centre over its two degrees of freedom
    distance: float
    bias: float  # of the distance, over itself
    bias_sigma: float  # of that mean

    @property
    def biased(self) -> bool:
        """Whether the bias exceeds the goal by more than three sigmas."""
        return abs(self.bias) > BIAS + 3 * self.bias_sigma


def measure_cell(run: Run, cell: Cell, count: int, draws: int) -> Errors:
    """Measure `draws` exposures of each of `count` views."""
    rng = np.random.default_rng(round(1e3 * (cell.diameter + cell.tilt + cell.noise + cell.blur)))
    pieces = 6 if cell.diameter < 40 else 4
    rows: list[Array] = []
    for sight in views(cell, count, rng):
        limit, clean = bound(sight, pieces), trace(sight, pieces)
        frames = (expose(clean, cell.noise, rng) for _ in range(draws))
        rows += [
            row for image in frames if (row := _errors(run, image, sight, limit, cell.noise)) is not None
        ]
    if len(rows) < draws:
        return Errors(len(rows) / count / draws, *[np.nan] * 6)
    squared, variance, detected, blind, chi2, distance, distance_variance = np.array(rows).T
    spread = np.sqrt(((distance - distance.mean()) ** 2).mean() / distance_variance.mean())
    sigma = distance.std() / np.sqrt(len(rows))
    return Errors(
        len(rows) / count / draws,
        np.sqrt(squared.mean() / variance.mean()),
        np.sqrt(detected.mean() / blind.mean()),
        chi2.mean() / 2,
        spread,
        distance.mean(),
        sigma,
    )


def _errors(run: Run, image: np.ndarray, sight: Sight, limit: Bound, noise: float) -> Array | None:
    """(7,) errors of one exposure; None if the roundel is not found.

    Of one coordinate: the squared error located, its bound, the squared error detected, its bound, and chi-square. Of
    the distance: the relative error and its bound.
    """
    found = run.make().detect(image)
    if len(found) != 1:
        return None
    true = ellipse_of(sight)[0]
    error = found[0].uv - true
    chi2 = error @ np.linalg.solve(found[0].cov, error)
    poses = locate(found[0], sight.lens, sight.diameter_m)
    if poses is None:
        return None
    distance = poses[0].position_m[2] / sight.distance_m - 1
    likelier, other = (pose.probability * (_ellipse_centre(sight, pose) - true) for pose in poses)
    located = likelier + other
    known, blind = (limit.centre_variance(noise, knows_lens) for knows_lens in (True, False))
    squared = located @ located / 2, known, error @ error / 2, blind
    return np.array([*squared, chi2, distance, limit.distance_variance(noise)])


def _ellipse_centre(sight: Sight, pose: DiscPose) -> Array:
    """(2,) centre of the outer ellipse of a pose, pixels."""
    there = replace(sight, uv=tuple(pose.centre_uv), distance_m=float(pose.position_m[2]))
    return ellipse_of(there.with_normal(pose.normal))[0]


def measure(run: Run, console: Console) -> list[Verdict]:
    """Print all cells and return the verdicts on the goals."""
    count, draws = (12, 100) if run.thorough else (6, 50)
    done = {cell: measure_cell(run, cell, count, draws) for cell in cells(run.thorough)}
    headings = (
        "diameter",
        "tilt",
        "noise",
        "blur",
        "ground",
        "found",
        "located/bound",
        "detected/bound",
        "chi2/2",
        "distance/bound",
        "bias %",
    )
    rows = [
        (
            f"{c.diameter:g}",
            f"{c.tilt:g}",
            f"{c.noise:g}",
            f"{c.blur:g}",
            f"{c.ground:g}",
            f"{e.found:.2f}",
            f"{e.centre:.2f}",
            f"{e.detected:.2f}",
            f"{e.chi2:.2f}",
            f"{e.distance:.2f}",
            f"{100 * e.bias:+.3f} ± {100 * e.bias_sigma:.3f}",
        )
        for c, e in done.items()
    ]
    console.print(table(f"{run.name}: errors over the Cramer-Rao bound", headings, rows))
    return _judge({c: e for c, e in done.items() if np.isfinite(e.centre)})


def _judge(done: dict[Cell, Errors]) -> list[Verdict]:
    slanted = [e for c, e in done.items() if 15 <= c.tilt <= 60]
    chi2 = [e.chi2 for e in done.values()]
    low, high = min(chi2), max(chi2)
    distance = max(e.distance for e in slanted)
    biased, bias = sum(e.biased for e in slanted), max(abs(e.bias) for e in slanted)
    far = f"{100 * bias:.3f} %, {biased} of {len(slanted)} cells beyond"
    return [
        *_judge_centre("centre, located", [e.centre for e in done.values()]),
        *_judge_centre("detected, lens unknown", [e.detected for e in done.values()]),
        Verdict(
            "chi-square over 2, all cells",
            f"{low:.2f} to {high:.2f}",
            "0.8 to 1.25",
            low >= 0.8 and high <= 1.25,
        ),
        Verdict("distance over the bound, worst", f"{distance:.2f}", f"<= {DISTANCE}", distance <= DISTANCE),
        Verdict("bias of the distance, worst cell", far, f"<= {100 * BIAS:g} %", biased == 0),
    ]


def _judge_centre(what: str, ratios: list[float]) -> list[Verdict]:
    pooled, worst = float(np.sqrt(np.mean(np.square(ratios)))), max(ratios)
    return [
        Verdict(f"{what}, RMS of all cells", f"{pooled:.2f}", f"<= {CENTRE}", pooled <= CENTRE),
        Verdict(f"{what}, worst cell", f"{worst:.2f}", f"<= {CENTRE_WORST}", worst <= CENTRE_WORST),
    ]
