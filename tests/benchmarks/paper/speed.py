# SPDX-License-Identifier: BSD-3-Clause
"""Table II: frames per second, searching and tracking."""

from collections.abc import Callable
from functools import partial
from itertools import cycle

import numpy as np

from camera_node.detection.detector import Detector
from camera_node.foundation.arrays import Grey
from tests.benchmarks.detector.pictures import Card, dead_leaves, expose, paste
from tests.benchmarks.detector.table import milliseconds, milliseconds_prepared
from tests.benchmarks.paper import published
from tests.benchmarks.paper.reference import PaperDetector
from tests.benchmarks.paper.report import Section, name_of, table
from tests.benchmarks.paper.scenes import BRIGHT, DARK

DISTANCE_M, NOISE = 1.5, 3.0
FRAMES = 16  # the interval of searches of unchanged parts: the unit in which tracking is timed
STEP_PX = 0.8  # motion from frame to frame


def render(resolution: tuple[int, int]) -> list[Grey]:
    """Frames of a pattern that moves slowly across the optical axis, on clutter at rest."""
    (w, h), lens = resolution, published.paper_lens(resolution)
    ground, frames = dead_leaves((h, w), np.random.default_rng(1)), []
    for k in range(4):
        card = Card((lens.cx + k * STEP_PX, lens.cy), lens.fx * published.PATTERN.d_o / DISTANCE_M, 0.2)
        frames.append(expose(paste(ground, [card], focal=lens.fx), NOISE, np.random.default_rng(k)))
    return frames


def time_frames(images: list[Grey], seconds: float) -> tuple[float, ...]:
    """Milliseconds a frame: search and tracking of ours, of the paper's search with our fit, search of the reference.

    Raises:
        RuntimeError: a detector does not find the pattern.
    """
    times: list[float] = []
    for make in (Detector, partial(Detector, detector="paper")):
        if len(make().detect(images[0])) != 1:
            raise RuntimeError(f"{make} does not find the pattern; its time has no meaning")
        times.append(milliseconds_prepared(lambda make=make: partial(make().detect, images[0]), seconds))
        tracker, turns = make(), cycle([*images, *images[-2:0:-1]])
        track: Callable[[], object] = lambda t=tracker, n=turns: [t.detect(next(n)) for _ in range(FRAMES)]  # noqa: E731
        times.append(milliseconds(track, seconds) / FRAMES)
    reference = PaperDetector((DARK + BRIGHT) / 2)
    times.append(milliseconds(lambda: reference.detect(images[0]), seconds))
    return tuple(times)


def measure(seconds: float = 0.5) -> Section:
    """Measure all resolutions on this machine, in one run."""
    rows, ratios = [], []
    for resolution in published.RESOLUTIONS:
        paper = published.TABLE_2[resolution]
        search, tracking, paper_search, paper_tracking, reference = time_frames(render(resolution), seconds)
        rows.append(
            (
                name_of(resolution),
                f"{paper.search:g} / {paper.tracking:g}",
                *(
                    f"{1e3 / a:.0f} / {1e3 / b:.0f}"
                    for a, b in ((search, tracking), (paper_search, paper_tracking))
                ),
                f"{1e3 / reference:.0f}",
            )
        )
        ratios.append(
            (
                name_of(resolution),
                f"{paper.tracking / paper.search:.1f}",
                f"{search / tracking:.1f}",
                f"{paper_search / search:.1f}",
                f"{paper_tracking / tracking:.1f}",
                f"{reference / search:.1f}",
            )
        )
    return Section(
        "Table II: frames per second, search / tracking",
        "The paper: capture to UDP on an OMAP3503 at 600 MHz; a camera of 60 Hz. Here: detection and fit alone, one "
        "thread of the machine that wrote this page, so that only the ratios of one run can be compared. Simulated "
        f'pattern at {DISTANCE_M:g} m on clutter. `Detector(detector="paper")` is the paper\'s search with local '
        "thresholds and our fit; the reference is Section III-B with one global threshold, labelled by OpenCV.",
        [
            table(
                ("resolution", "paper", "ours", 'ours, detector="paper"', "reference, search"),
                rows,
            ),
            table(
                (
                    "ratio",
                    "tracking/search, paper",
                    "tracking/search, ours",
                    'ours/detector="paper", search',
                    'ours/detector="paper", tracking',
                    "ours/reference, search",
                ),
                ratios,
            ),
        ],
    )
