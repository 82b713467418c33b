# SPDX-License-Identifier: BSD-3-Clause
"""Time per frame on one thread, cold and tracked, compared with a memory copy, OpenCV's contours and square tags."""

from dataclasses import dataclass
from functools import partial
from itertools import cycle, product

import cv2
import numpy as np
from rich.console import Console

from camera_node.foundation.arrays import Array
from tests.benchmarks.detector.pictures import (
    NOISE,
    Card,
    F,
    Grey,
    dead_leaves,
    expose,
    flat,
    grid,
    missed,
    paste,
)
from tests.benchmarks.detector.table import Run, Verdict, milliseconds, milliseconds_prepared, table
from tests.benchmarks.detector.tags import measure_tags, tag_detectors

SIZES = ((480, 640), (720, 1280), (1080, 1920))
COUNTS = (0, 1, 10, 50)
STEP = (2.3, -1.4)  # pixels that the markers move from frame to frame
INTERVAL = 16  # frames between two searches of unchanged parts: the unit in which tracking is timed
EVENLY = 6  # frames of constant velocity before the markers turn back
GOALS = {  # by lines: milliseconds with 50 markers, and with none or one
    480: (0.3, 0.1),
    720: (0.7, 0.25),
    1080: (1.5, 0.9),
}
OVER_OPENCV, TRACKED_US = 30, 15


def place_cards(
    count: int, size: tuple[int, int], rng: np.random.Generator, px: float | None = None
) -> list[Card]:
    """Cards at 0 to 40 degrees, 18 to 44 px wide in images 640 px wide and scaled with the width, or all `px` wide."""
    scale = size[1] / 640
    widths = rng.uniform(18, 44, count) * scale if px is None else np.full(count, px)
    turns = rng.uniform((0, 0), (0.7, 2 * np.pi), (count, 2))
    places = grid(count, size, rng)
    return [Card(uv, float(d), *t) for uv, d, t in zip(places, widths, turns.tolist(), strict=True)]


def walk(there: list[Card], frames: int) -> list[list[Card]]:
    """The positions of the same markers in each frame."""
    return [
        [Card((c.uv[0] + k * STEP[0], c.uv[1] + k * STEP[1]), c.diameter, c.tilt, c.turn) for c in there]
        for k in range(frames)
    ]


def contours(image: Grey) -> None:
    """The usual approach: a global threshold, its contours, and an ellipse for each."""
    _, binary = cv2.threshold(image, 0, 255, cv2.THRESH_BINARY | cv2.THRESH_OTSU)
    for contour in cv2.findContours(binary, cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)[0]:
        if len(contour) >= 20:
            cv2.fitEllipse(contour)


@dataclass(frozen=True)
class Times:
    """Milliseconds per image: ours cold and tracked (mean), a memory copy, and OpenCV's contours."""

    found: int
    cold: float
    tracked: float
    memory: float
    opencv: float

    def row(self) -> tuple[str, ...]:
        ratios = f"{self.cold / self.memory:.0f}", f"{self.opencv / self.cold:.1f}"
        return f"{self.found}", f"{self.cold:.3f}", f"{self.tracked:.3f}", *ratios, f"{self.opencv:.2f}"


def measure_frame(run: Run, ground: Array, there: list[Card], seconds: float, steps: int = 2) -> Times:
    """Measure one image; tracking goes back and forth over `steps` frames.

    With two frames every prediction is wrong by two steps.
    """
    rng = np.random.default_rng(len(there))
    focal = F * ground.shape[1] / 640  # the same lens at any resolution
    frames = [expose(paste(ground, cards, focal=focal), NOISE, rng) for cards in walk(there, steps)]
    image, scratch = frames[0], np.empty_like(frames[0])
    tracker, turns = run.make(), cycle([*frames, *frames[-2:0:-1]])
    return Times(
        len(there) - missed(there, run.make().detect(image).uv),
        milliseconds_prepared(lambda: partial(run.make().detect, image), seconds),
        milliseconds(lambda: [tracker.detect(next(turns)) for _ in range(INTERVAL)], seconds) / INTERVAL,
        milliseconds(lambda: np.copyto(scratch, image), seconds / 2),
        milliseconds(lambda: contours(image), seconds / 2),
    )


def measure(run: Run, console: Console) -> list[Verdict]:
    """Print the times of all sizes and return the verdicts on the goals."""
    cv2.setNumThreads(1)
    seconds = 0.5 if run.thorough else 0.1
    rows, in_clutter = [], {}
    for size, kind, count in product(SIZES, ("flat", "clutter"), COUNTS):
        rng = np.random.default_rng((size[0], count))
        ground = flat(size, 128.0) if kind == "flat" else dead_leaves(size, rng)
        there = place_cards(count, size, rng)
        times = measure_frame(run, ground, there, seconds)
        tags = measure_tags(ground, there, seconds / 2)
        rows.append((f"{size[1]}x{size[0]} {kind}", count, *times.row(), *tags))
        if kind == "clutter":
            in_clutter[size[0], count] = times
    ours = ("found", "cold ms", "tracked ms", "x memcpy", "OpenCV/ours")
    headings = ("picture", "there", *ours, "OpenCV ms", *tag_detectors())
    console.print(table(f"{run.name}: time a frame", headings, rows))
    return [*_judge(in_clutter), *(_judge_tracked(run, seconds, steps) for steps in (2, EVENLY))]


def _judge(times: dict[tuple[int, int], Times]) -> list[Verdict]:
    verdicts = []
    for lines, (many, few) in GOALS.items():
        fifty, one = times[lines, 50].cold, max(times[lines, 0].cold, times[lines, 1].cold)
        what = f"{lines} lines, clutter"
        verdicts.append(Verdict(f"{what}, 50 markers", f"{fifty:.2f} ms", f"<= {many} ms", fifty <= many))
        verdicts.append(Verdict(f"{what}, 0 or 1", f"{one:.2f} ms", f"<= {few} ms", one <= few))
        later = max(times[lines, 0].tracked, times[lines, 1].tracked)
        verdicts.append(
            Verdict(
                f"{what}, 0 or 1, frames after the first", f"{later:.2f} ms", f"<= {few} ms", later <= few
            )
        )
    least = min(times[lines, 50].opencv / times[lines, 50].cold for lines in GOALS)
    what = "threshold + findContours + fitEllipse over ours, 50 markers"
    return [*verdicts, Verdict(what, f"{least:.1f} times", f">= {OVER_OPENCV}", least >= OVER_OPENCV)]


def _judge_tracked(run: Run, seconds: float, steps: int) -> Verdict:
    """The time for one more tracked marker of 20 px: a frame of 50 minus one of none."""
    ground = flat((480, 640), 128.0)
    there = place_cards(50, (480, 640), np.random.default_rng(5), 20.0)
    many, none = (measure_frame(run, ground, cards, 2 * seconds, steps).tracked for cards in (there, []))
    cost = 1e3 * (many - none) / len(there)
    turns = "in every frame" if steps == 2 else f"after {steps - 1} frames"
    what = f"tracked, a marker of 20 px that turns back {turns}"
    return Verdict(what, f"{cost:.1f} us", f"<= {TRACKED_US} us", cost <= TRACKED_US)
