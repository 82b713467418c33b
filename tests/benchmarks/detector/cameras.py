# SPDX-License-Identifier: BSD-3-Clause
"""The detector behind clean, mild and harsh cameras: shares found, errors over claims, and false positives.

A detector learns a camera's response from roundels, so each measurement starts with a detector that has seen three
frames of the camera and then forgot their roundels. Goals hold for the mild camera.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from typing import Protocol

import numpy as np
from rich.console import Console

from camera_node.detection.detector import Detector
from camera_node.detection.roundels import Roundel
from camera_node.foundation.arrays import Array, Grey
from camera_node.simulation.sensor import SENSORS, Sensor
from tests.benchmarks.detector.negatives import COMMON, clutter, letters, rings, text_pages
from tests.benchmarks.detector.photographs import photographs
from tests.benchmarks.detector.pictures import Card, flat, grid, missed, paste, sight_of
from tests.benchmarks.detector.recall import SIZE, blur_by_motion, ground, occlude, show
from tests.benchmarks.detector.table import Run, Verdict, table
from tests.camera_node.tracing import Sight, ellipse_of

FORGET = 32  # frames in which a detector forgets its tracks
GREY_FLOOR = 0.3  # share of the contrast at which a grey floor lies above ink
PRINTS = (0.3, 0.5, 0.7)  # inner ratios that no detector is given
PRINT_FOUND = 0.97
SIZES = ((14, 20), (20, 32), (32, 60))  # pixels
Light = Callable[[np.random.Generator], tuple[Array, list[Card]]]


class Camera(Protocol):
    """What makes a picture of light."""

    def expose(self, light: Array, rng: np.random.Generator) -> Grey:
        """The picture (h, w), uint8, of light (h, w) in linear levels of 255."""
        ...


Disturb = Callable[[Array, list[Card], np.random.Generator], Array]
GROUNDS = ("even", "clutter")  # around the cards


def acquainted(run: Run, sensor: Camera) -> Detector:
    """A detector that has learned a camera's response, and tracks nothing."""
    detector = run.make()
    for seed in range(3):
        rng = np.random.default_rng((9, seed))
        light, _ = uncovered(rng)
        detector.detect(sensor.expose(light, rng))
    blank = np.full(SIZE, 120, np.uint8)
    for _ in range(FORGET):
        detector.detect(blank)
    return detector


def cards(rng: np.random.Generator, low: float = 20, high: float = 44) -> list[Card]:
    """Thirty cards of these diameters, tilted by up to 40 degrees."""
    return show(lambda: float(rng.uniform(low, high)), float(rng.uniform(0, 40)), 30, rng)


def uncovered(rng: np.random.Generator) -> tuple[Array, list[Card]]:
    """Cards on clutter."""
    shown = cards(rng)
    return paste(ground("clutter", rng), shown), shown


def covered(share: float, from_rim: bool, rng: np.random.Generator) -> tuple[Array, list[Card]]:
    """Cards with a bar across, as in `recall.occluded`."""
    light, shown = uncovered(rng)
    for card in shown:
        occlude(light, card, share, 1.0 if from_rim else rng.uniform(-1, 1), rng)
    return light, shown


def over_exposed(paper: float, rng: np.random.Generator) -> tuple[Array, list[Card]]:
    """Cards whose paper has a level above 255, on white."""
    shown = cards(rng)
    return paste(flat(SIZE, paper), shown, dark=40.0, bright=paper), shown


def on_grey(low: float, high: float, rng: np.random.Generator) -> tuple[Array, list[Card]]:
    """Cards on a floor between ink and paper."""
    shown = cards(rng, low, high)[: 30 if high < 60 else 12]
    if high >= 60:
        shown = show(lambda: float(rng.uniform(low, high)), float(rng.uniform(0, 40)), 8, rng)
    return paste(flat(SIZE, 40.0 + GREY_FLOOR * 150.0), shown), shown


def moving(rng: np.random.Generator) -> tuple[Array, list[Card]]:
    """Cards of 24 to 40 px that move by 10 px during the exposure."""
    shown = show(lambda: float(rng.uniform(24, 40)), float(rng.uniform(0, 30)), 24, rng)
    return blur_by_motion(paste(ground("clutter", rng), shown), 10.0, rng.uniform(0, np.pi)), shown


FINDS: dict[str, tuple[Light, float]] = {
    "uncovered, 20 to 44 px": (uncovered, 0.99),
    "20 % covered, anywhere": (partial(covered, 0.2, False), 0.8),
    "20 % covered, from the rim": (partial(covered, 0.2, True), 0.9),
    "30 % covered, anywhere": (partial(covered, 0.3, False), 0.4),
    "paper at 308 of 255": (partial(over_exposed, 308.0), 0.97),
    "paper at 410 of 255": (partial(over_exposed, 410.0), 0.95),
    "grey floor, 20 to 44 px": (partial(on_grey, 20.0, 44.0), 0.99),
    "grey floor, 60 to 100 px": (partial(on_grey, 60.0, 100.0), 0.99),
    "motion of 10 px at 24 to 40 px": (moving, 0.9),
}
MISSING: dict[str, Callable[[int], Iterator[Grey]]] = {
    "letters": letters,
    "rings of other ratios": rings,
    "pages of text": text_pages,
    "dead leaves": clutter,
    "photographs": photographs,
}


def share_found(known: Detector, sensor: Camera, light: Light, frames: int, seed: int = 0) -> float:
    """The share of the cards of so many pictures that is found in the first frame of each."""
    there = lost = 0
    for frame in range(frames):
        rng = np.random.default_rng((frame, seed))
        picture, shown = light(rng)
        found = known.adjusted().detect(sensor.expose(picture, rng))
        there, lost = there + len(shown), lost + missed(shown, found.uv)
    return 1 - lost / there


def share_of_print(run: Run, sensor: Camera, ratio: float, frames: int, frame: int = 2) -> float:
    """The share of the cards of an unknown print that a new detector finds in this frame of each picture."""
    there = lost = 0
    for seed in range(frames):
        rng = np.random.default_rng((seed, run.seed))
        shown = [replace(card, ratio=ratio) for card in cards(rng)]
        light, detector = paste(ground("clutter", rng), shown), run.make()
        for _ in range(frame - 1):
            detector.detect(sensor.expose(light, rng))
        found = detector.detect(sensor.expose(light, rng))
        there, lost = there + len(shown), lost + missed(shown, found.uv)
    return 1 - lost / there


@dataclass(frozen=True)
class Errors:
    """Errors of one band of sizes.

    Attributes:
        found: share of the views.
        centre, size: mean squared errors over the claimed variances, 1 is due for each coordinate.
        bias: mean relative error of the diameter.
        bias_sigma: standard deviation of that mean.
    """

    found: float
    centre: float
    size: float
    bias: float
    bias_sigma: float


def errors(
    known: Detector,
    sensor: Camera,
    band: tuple[int, int],
    frames: int,
    disturb: Disturb | None = None,
    on: str = "even",
    seed: int = 0,
) -> Errors:
    """Measure cards of random sizes in a band, tilted by up to 60 degrees, on a ground, in disturbed light."""
    rng = np.random.default_rng((*band, seed))
    rows, there = [], 0
    for _ in range(frames):
        shown = [
            Card(
                uv,
                float(rng.uniform(*band)),
                float(rng.uniform(0, np.pi / 3)),
                float(rng.uniform(0, 2 * np.pi)),
            )
            for uv in grid(20, SIZE, rng)
        ]
        light = paste(flat(SIZE, 90.0) if on == "even" else ground(on, rng), shown)
        found = known.adjusted().detect(sensor.expose(disturb(light, shown, rng) if disturb else light, rng))
        there += len(shown)
        for card in shown:
            off = np.linalg.norm(found.uv - card.uv, axis=1)
            if off.min(initial=np.inf) < 0.2 * card.diameter:
                rows.append(errors_of(found[int(off.argmin())], sight_of(card, (SIZE[1], SIZE[0]))))
    if len(rows) < 2:
        return Errors(len(rows) / there, *[np.nan] * 4)
    centre, size, bias = np.array(rows).T
    sigma = float(bias.std() / np.sqrt(len(bias)))
    return Errors(len(rows) / there, centre.mean(), size.mean(), bias.mean(), sigma)


def errors_of(found: Roundel, sight: Sight) -> tuple[float, float, float]:
    """Squared errors of centre and size over their variances, and the relative error of the size."""
    assert found.pose_cov is not None
    centre, axes = ellipse_of(sight)
    error, size = found.uv - centre, (found.axes_px.sum() - axes.sum()) / 2
    by_size = np.array([1.0, 0.0, 1.0])  # the trace of the shape is the mean of the diameters
    variance = by_size @ found.pose_cov[2:5, 2:5] @ by_size
    chi2 = error @ np.linalg.solve(found.cov, error) / 2
    return float(chi2), float(size**2 / variance), float(2 * size / axes.sum())


def false_positives(known: Detector, sensor: Sensor, pages: Iterator[Grey]) -> int:
    """The number of roundels found in pictures without any."""
    rng = np.random.default_rng(0)
    return sum(
        len(known.adjusted(inner_ratios=COMMON).detect(sensor.expose(page.astype(float), rng)))
        for page in pages
    )


def measure(run: Run, console: Console) -> list[Verdict]:
    """Print the tables of all cameras, and return the verdicts on the mild one's goals."""
    frames, pages = (40, 200) if run.thorough else (5, 10)
    known = {name: acquainted(run, sensor) for name, sensor in SENSORS.items()}
    found = {
        (what, name): share_found(known[name], sensor, light, frames)
        for what, (light, _) in FINDS.items()
        for name, sensor in SENSORS.items()
    }
    rows = [(what, *(f"{100 * found[what, name]:.0f}" for name in SENSORS)) for what in FINDS]
    console.print(table(f"{run.name}: % found on the first frame, by camera", ("", *SENSORS), rows))
    prints = {
        (ratio, name): share_of_print(run, sensor, ratio, frames)
        for ratio in PRINTS
        for name, sensor in SENSORS.items()
    }
    rows = [(f"{ratio}", *(f"{100 * prints[ratio, name]:.0f}" for name in SENSORS)) for ratio in PRINTS]
    title = f"{run.name}: % of an unknown print found on the second frame, by camera"
    console.print(table(title, ("inner ratio", *SENSORS), rows))
    bands = {
        (band, name, on): errors(known[name], sensor, band, 2 * frames, on=on)
        for on in GROUNDS
        for band in SIZES
        for name, sensor in SENSORS.items()
    }
    rows = [
        (
            f"{band[0]} to {band[1]} px, {name}, {on}",
            f"{e.found:.2f}",
            f"{e.centre:.1f}",
            f"{e.size:.1f}",
            f"{100 * e.bias:+.2f} ± {100 * e.bias_sigma:.2f}",
        )
        for (band, name, on), e in bands.items()
    ]
    headings = ("", "found", "centre²/claim", "size²/claim", "size bias %")
    console.print(table(f"{run.name}: squared errors over the claimed variance", headings, rows))
    wrong = {
        (what, name): false_positives(known[name], sensor, make(pages))
        for what, make in MISSING.items()
        for name, sensor in SENSORS.items()
    }
    rows = [(f"{pages} {what}", *(wrong[what, name] for name in SENSORS)) for what in MISSING]
    console.print(table(f"{run.name}: false positives, by camera", ("", *SENSORS), rows))
    return [
        *(_judge_found(what, found[what, "mild"], goal) for what, (_, goal) in FINDS.items()),
        *(_judge_found(f"unknown print of {ratio}", prints[ratio, "mild"], PRINT_FOUND) for ratio in PRINTS),
        *(_judge_errors(band, on, bands[band, "mild", on]) for on in GROUNDS for band in SIZES),
        *(_judge_false(what, wrong[what, "mild"]) for what in MISSING),
    ]


def _judge_found(what: str, share: float, goal: float) -> Verdict:
    return Verdict(f"mild camera: {what}", f"{100 * share:.1f} %", f">= {100 * goal:g} %", share >= goal)


def _judge_errors(band: tuple[int, int], on: str, e: Errors) -> Verdict:
    worst = max(e.centre, e.size)
    return Verdict(
        f"mild camera: squared errors over claims, {band[0]} to {band[1]} px, {on} ground",
        f"{worst:.1f}",
        "<= 1.5",
        worst <= 1.5,
    )


def _judge_false(what: str, count: int) -> Verdict:
    return Verdict(f"mild camera: false positives, {what}", str(count), "0", count == 0)
