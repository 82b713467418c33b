# SPDX-License-Identifier: BSD-3-Clause
"""D: the smallest roundel that our detector finds in a new image, by ground, slant, blur and contrast."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from camera_node.detection.detector import Detector
from camera_node.foundation.arrays import Array
from camera_node.sensor_model import threshold
from camera_node.sensor_model.imaging import Ground, Imaging
from camera_node.simulation import floor, renderer
from tests.benchmarks.detector.pictures import Card, Grey, dead_leaves, expose, flat, grid, missed, paste
from tests.benchmarks.detector.recall import blur_by_motion
from tests.benchmarks.paper.report import Section, table

SIZE = (300, 400)
CARDS, FRAMES = 40, 8
RECALL, NOISE, MIDDLE = 0.99, 3.0, 115.0
FOCAL = 6000.0  # pixels; so long that no angle from the optical axis changes the ratio of the axes
SMALLEST_PX, LARGEST_PX, STEP = 6.5, 48.0, 1.05
# Of the even ground, between ink at 0 and paper at 1: the simulated arena's.
FLOOR = (floor.FLOOR - renderer.BLACK) / (renderer.WHITE - renderer.BLACK)
GROUNDS: tuple[Ground, ...] = ("cluttered", "even")
MOTION_SHARES = (0.1, 0.25, 0.5, 0.75, 1.0)
MOTION_PX = (16, 20, 24, 32, 48)


@dataclass(frozen=True)
class Condition:
    """Ground, slant in degrees, blur in pixels, and contrast in grey levels."""

    ground: Ground = "cluttered"
    slant: float = 0.0
    blur: float = 0.7
    contrast: float = 150.0


@dataclass(frozen=True)
class Limits:
    """Frontal diameters, pixels, at which half and nearly all roundels are found; NaN if above `LARGEST_PX`."""

    half: float
    nearly_all: float


@lru_cache
def limits(condition: Condition) -> Limits:
    """Measure both limits of one condition.

    Half is the first crossing of 50 %, linear in the logarithm of the diameter. Nearly all is the first diameter with
    99 % of the roundels of that size and the next two, 5 % larger each.
    """
    half, sizes, shares = np.nan, [SMALLEST_PX / STEP], [0.0]
    for d in _diameters():
        sizes, shares = [*sizes, d], [*shares, share_found(condition, d)]
        if np.isnan(half) and shares[-1] >= 0.5:
            half = sizes[-2] * STEP ** ((0.5 - shares[-2]) / (shares[-1] - shares[-2]))
        if np.mean(shares[-3:]) >= RECALL:
            return Limits(float(half), sizes[-3])
    return Limits(float(half), np.nan)


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
    slant = float(np.radians(condition.slant))
    cards = [Card(uv, diameter_px, slant, float(rng.uniform(0, 2 * np.pi))) for uv in grid(CARDS, SIZE, rng)]
    ground = _ground(condition.ground, dark, bright, rng)
    light = paste(ground, cards, condition.blur, dark=dark, bright=bright, focal=FOCAL)
    return expose(light, NOISE, rng), cards


def _ground(name: Ground, dark: float, bright: float, rng: np.random.Generator) -> Array:
    """Clutter, or one grey level between ink and paper."""
    return dead_leaves(SIZE, rng) if name == "cluttered" else flat(SIZE, dark + FLOOR * (bright - dark))


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
    slants = [(f"{slant:g}°", *_row(replace(base, slant=slant))) for slant in (*threshold.SLANT_DEG, 75.0)]
    blurs = [(f"{b:g} px", *_row(replace(base, blur=b))) for b in threshold.BLUR_PX]
    contrasts = [(f"{c:g}", *_row(replace(base, contrast=c))) for c in (150.0, 100.0, 60.0, 40.0)]
    moving = [
        (f"{d} px", *(f"{100 * share_of_moving(d, share):.0f}" for share in MOTION_SHARES)) for d in MOTION_PX
    ]
    columns = [f"{ground}, {what}" for ground in GROUNDS for what in ("half", "99 %")]
    return Section(
        "Threshold D of our detector",
        "Major axis in pixels at which half of the roundels, and from which on 99 %, are found in a new image "
        "(simulated: dead-leaves clutter, or an even ground as bright as the simulated arena's, 0.53 between ink and "
        "paper; noise 3 grey levels; the card is 9/7 of the disc). Each cell: measured / model "
        "(`camera_node/sensor_model/threshold.py`). The paper's D is 11 px. A dash: none up to "
        f"{LARGEST_PX:g} px. Clutter with more contrast than the print hides faint "
        "roundels.",
        [
            table(("slant", *columns), slants),
            table(("blur (sigma)", *columns), blurs),
            table(("contrast", *columns), contrasts),
            table(("% found of moving ones", *(f"{s:g} diameters" for s in MOTION_SHARES)), moving),
        ],
    )


def _row(condition: Condition) -> list[str]:
    """Measured and predicted limits on each ground."""
    cells = []
    for ground in GROUNDS:
        got = limits(replace(condition, ground=ground))
        for size, share in ((got.half, 0.5), (got.nearly_all, RECALL)):
            imaging = Imaging(blur_px=condition.blur, ground=ground)
            model = threshold.smallest_major_px(np.radians(condition.slant), imaging, share)
            cells.append(f"{_size(size)} / {_size(float(model))}")
    return cells


def _size(px: float) -> str:
    return f"{px:.1f}" if np.isfinite(px) else "-"
