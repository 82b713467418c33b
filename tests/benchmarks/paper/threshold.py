# SPDX-License-Identifier: BSD-3-Clause
"""D: the smallest roundel that our detector finds in a new image, by ground, slant, blur and contrast."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from camera_node.arrays import Array
from camera_node.detection.detector import Detector
from camera_node.sensor_model import threshold
from tests.benchmarks.detector.pictures import Card, Grey, dead_leaves, expose, flat, grid, missed, paste
from tests.benchmarks.detector.recall import blur_by_motion
from tests.benchmarks.paper.report import Section, table

SIZE = (300, 400)
CARDS, FRAMES = 40, 3
RECALL, NOISE, MIDDLE = 0.99, 3.0, 115.0
SMALLEST_PX, LARGEST_PX, STEP = 7.0, 48.0, 1.05
GROUNDS = ("white", "clutter")
MOTION_SHARES = (0.1, 0.25, 0.5, 0.75, 1.0)
MOTION_PX = (16, 20, 24, 32, 48)


@dataclass(frozen=True)
class Condition:
    """Ground, slant in degrees, blur in pixels, and contrast in grey levels."""

    ground: str = "clutter"
    slant: float = 0.0
    blur: float = 0.7
    contrast: float = 150.0


@lru_cache
def smallest(condition: Condition) -> float | None:
    """The smallest frontal diameter, pixels, from which on 99 % are found; None if more than `LARGEST_PX`.

    It is the first one of which the next two, 5 % larger each, have that recall too.
    """
    passed: list[float] = []
    for d in _diameters():
        passed = [*passed, d] if share_found(condition, d) >= RECALL else []
        if len(passed) == 3:
            return passed[0]
    return None


def _diameters() -> Iterator[float]:
    d = SMALLEST_PX
    while d <= LARGEST_PX * STEP**2:
        yield d
        d *= STEP


def share_found(condition: Condition, diameter_px: float) -> float:
    """The share of the roundels of a few new images that a new detector finds."""
    there = lost = 0
    for seed in range(FRAMES):
        rng = np.random.default_rng(seed)
        image, cards = render(condition, diameter_px, rng)
        there, lost = there + len(cards), lost + missed(cards, Detector(min_diameter_px=6).detect(image).uv)
    return 1 - lost / there


def render(condition: Condition, diameter_px: float, rng: np.random.Generator) -> tuple[Grey, list[Card]]:
    """Cards of one size and slant, in random directions, on the condition's ground."""
    dark, bright = MIDDLE - condition.contrast / 2, MIDDLE + condition.contrast / 2
    own = np.random.default_rng(1)
    slant = float(np.radians(condition.slant))
    cards = [Card(uv, diameter_px, slant, float(own.uniform(0, 2 * np.pi))) for uv in grid(CARDS, SIZE, own)]
    ground = _ground(condition.ground, bright, rng)
    return expose(paste(ground, cards, condition.blur, dark=dark, bright=bright), NOISE, rng), cards


def _ground(name: str, bright: float, rng: np.random.Generator) -> Array:
    return dead_leaves(SIZE, rng) if name == "clutter" else flat(SIZE, bright)


def share_of_moving(diameter_px: float, share: float, frames: int = 4) -> float:
    """The share found of roundels that move by `share` of their diameter during the exposure."""
    there = lost = 0
    for seed in range(frames):
        rng = np.random.default_rng(seed)
        cards = [
            Card(uv, diameter_px, float(rng.uniform(0, 0.5)), float(rng.uniform(0, 2 * np.pi)))
            for uv in grid(20 if diameter_px < 40 else 12, SIZE, rng)
        ]
        ground = flat(SIZE, 90.0) if seed % 2 else dead_leaves(SIZE, rng)
        light = blur_by_motion(paste(ground, cards), share * diameter_px, float(rng.uniform(0, np.pi)))
        there += len(cards)
        lost += missed(cards, Detector().detect(expose(light, NOISE, rng)).uv)
    return 1 - lost / there


def measure() -> Section:
    """Measure all conditions."""
    base = Condition()
    slants = [
        (
            f"{slant:g}°",
            *(_cell(replace(base, ground=g, slant=slant)) for g in GROUNDS),
            f"{float(threshold.smallest_major_px(np.radians(slant), base.blur)):.1f}",
            f"{float(threshold.threshold_D(np.radians(slant), base.blur)):.1f}",
        )
        for slant in (*threshold.SLANT_DEG, 75.0)
    ]
    blurs = [
        (f"{b:g} px", _cell(replace(base, blur=b)), f"{float(threshold.smallest_major_px(0.0, b)):.1f}")
        for b in threshold.BLUR_PX
    ]
    contrasts = [
        (f"{c:g}", *(_cell(replace(base, ground=g, contrast=c)) for g in GROUNDS))
        for c in (150.0, 100.0, 60.0, 40.0)
    ]
    moving = [
        (f"{d} px", *(f"{100 * share_of_moving(d, share):.0f}" for share in MOTION_SHARES)) for d in MOTION_PX
    ]
    return Section(
        "Threshold D of our detector",
        "Smallest major axis in pixels from which on 99 % are found in a new image (simulated: dead-leaves clutter or "
        "an even ground as bright as paper; noise 3 grey levels; the card is 9/7 of the disc). The "
        f"paper's D is 11 px. A dash: none up to {LARGEST_PX:g} px. The columns of the model are "
        "`camera_node/sensor_model/threshold.py`. Clutter with more contrast than the print hides faint roundels.",
        [
            table(("slant", *GROUNDS, "model", "model, minor axis"), slants),
            table(("blur (sigma)", "clutter", "model"), blurs),
            table(("contrast", *GROUNDS), contrasts),
            table(("% found of moving ones", *(f"{s:g} diameters" for s in MOTION_SHARES)), moving),
        ],
    )


def _cell(condition: Condition) -> str:
    size = smallest(condition)
    return "-" if size is None else f"{size:.1f}"
