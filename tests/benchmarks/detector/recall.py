# SPDX-License-Identifier: BSD-3-Clause
"""Share of roundels found on the first frame: small, tilted, occluded, motion-blurred and faint ones."""

from collections.abc import Callable, Iterator
from itertools import product

import cv2
import numpy as np
from rich.console import Console

from camera_node.foundation.arrays import Array
from tests.benchmarks.detector.pictures import (
    NOISE,
    Card,
    Grey,
    dead_leaves,
    expose,
    flat,
    grid,
    missed,
    paste,
)
from tests.benchmarks.detector.table import Run, Verdict, table

SIZE = (480, 640)
GROUNDS = ("white", "clutter", "dark")
SMALLEST = {
    ("white", 0): 9,
    ("white", 45): 11,
    ("clutter", 0): 11,
    ("clutter", 45): 14,
    ("dark", 0): 11,
    ("dark", 45): 14,
}
DIAMETERS = (7, 8, 9, 10, 11, 12, 13, 14, 16, 18, 20)
RECALL = 0.99
Picture = Callable[[np.random.Generator], tuple[Grey, list[Card]]]


def ground(name: str, rng: np.random.Generator) -> Array:
    """White paper, clutter as in photographs, or a dark floor."""
    return dead_leaves(SIZE, rng) if name == "clutter" else flat(SIZE, 190.0 if name == "white" else 40.0)


def show(px: Callable[[], float], tilt_deg: float, n: int, rng: np.random.Generator) -> list[Card]:
    """`n` cards with one tilt in random directions."""
    tilt = float(np.radians(tilt_deg))
    return [Card(uv, px(), tilt, float(rng.uniform(0, 2 * np.pi))) for uv in grid(n, SIZE, rng)]


def recall(run: Run, frames: int, picture: Picture) -> float:
    """The share of the cards in `frames` images that a new detector finds."""
    there = lost = 0
    for seed in range(frames):
        image, shown = picture(np.random.default_rng(seed))
        there, lost = there + len(shown), lost + missed(shown, run.make().detect(image).uv)
    return 1 - lost / there


def of_size(name: str, diameter: float, tilt_deg: float) -> Picture:
    """Sixty cards of one size on one ground, at sixty subpixel positions."""

    shown = show(lambda: diameter, tilt_deg, 60, np.random.default_rng(1))

    def picture(rng: np.random.Generator) -> tuple[Grey, list[Card]]:
        return expose(paste(ground(name, rng), shown), NOISE, rng), shown

    return picture


def occluded(share: float, from_rim: bool) -> Picture:
    """Cards with a bar across, `share` of the diameter wide, of random grey level and direction.

    The bar covers the outermost part of the disc if `from_rim`, otherwise a random part.
    """

    def picture(rng: np.random.Generator) -> tuple[Grey, list[Card]]:
        shown = show(lambda: float(rng.uniform(20, 44)), float(rng.uniform(0, 40)), 30, rng)
        image = paste(ground("clutter", rng), shown)
        for card in shown:
            occlude(image, card, share, 1.0 if from_rim else rng.uniform(-1, 1), rng)
        return expose(image, NOISE, rng), shown

    return picture


def occlude(image: Array, card: Card, share: float, place: float, rng: np.random.Generator) -> None:
    """Draw a bar of random level and direction across a card; `place` from -1 to 1 is its position."""
    turn, level = rng.uniform(0, np.pi), float(rng.uniform(0, 255))
    reach = int(0.8 * card.diameter)
    x0, y0 = (int(c) - reach for c in card.uv)
    box = image[max(y0, 0) : y0 + 2 * reach, max(x0, 0) : x0 + 2 * reach]
    v, u = np.mgrid[: box.shape[0], : box.shape[1]] + np.array([max(y0, 0), max(x0, 0)])[:, None, None]
    across = (u - card.uv[0]) * np.cos(turn) + (v - card.uv[1]) * np.sin(turn)
    middle = place * (1 - share) * card.diameter / 2
    part = np.clip(share * card.diameter / 2 + 0.5 - np.abs(across - middle), 0, 1)
    part = cv2.GaussianBlur(part, (0, 0), 0.7)
    box += part * (level - box)


def blur_by_motion(image: Array, length: float, turn: float) -> Array:
    """The image moved by `length` pixels during its exposure."""
    side = int(length) // 2 * 2 + 3
    step = np.linspace(-0.5, 0.5, 8 * side)[:, None] * length * [np.cos(turn), np.sin(turn)] + side // 2
    kernel, low = np.zeros((side + 1, side + 1)), np.floor(step).astype(int)
    part = step - low
    for du in (0, 1):
        for dv in (0, 1):
            weight = abs(1 - du - part[:, 0]) * abs(1 - dv - part[:, 1])
            np.add.at(kernel, (low[:, 1] + dv, low[:, 0] + du), weight / len(step))
    anchor = (side // 2, side // 2)
    return np.asarray(cv2.filter2D(image, -1, kernel, anchor=anchor, borderType=cv2.BORDER_REPLICATE), float)


def moving(rng: np.random.Generator) -> tuple[Grey, list[Card]]:
    """Cards of 32 px that move by 24 px during the exposure, on white or on clutter."""
    shown = show(lambda: 32.0, float(rng.uniform(0, 30)), 24, rng)
    image = paste(ground(str(rng.choice(["white", "clutter"])), rng), shown)
    return expose(blur_by_motion(image, 24.0, rng.uniform(0, np.pi)), NOISE, rng), shown


def faint(rng: np.random.Generator) -> tuple[Grey, list[Card]]:
    """Cards with a contrast of a tenth of the scale, on a ground of their white."""
    shown = show(lambda: float(rng.uniform(20, 44)), float(rng.uniform(0, 40)), 30, rng)
    return expose(paste(flat(SIZE, 140.5), shown, dark=115.0, bright=140.5), NOISE, rng), shown


HARD = (
    ("occlusion of 20 % of the diameter", occluded(0.2, False), 0.9),
    ("occlusion of 30 % of the diameter", occluded(0.3, False), 0.5),
    ("occlusion of 20 %, from the rim", occluded(0.2, True), 0.9),
    ("occlusion of 30 %, from the rim", occluded(0.3, True), 0.5),
    ("motion blur of 24 px on 32 px", moving, 0.95),
    ("contrast of 10 %", faint, 0.95),
)


def measure(run: Run, console: Console) -> list[Verdict]:
    """Print recall by diameter and return the verdicts on the goals."""
    frames = 40 if run.thorough else 5
    tilts = (0, 30, 45, 60) if run.thorough else (0, 45)
    shares = {
        (name, tilt, d): recall(run, frames, of_size(name, d, tilt))
        for tilt, d, name in product(tilts, DIAMETERS, GROUNDS)
    }
    rows = [
        (f"{name}, {tilt} degrees", *(f"{100 * shares[name, tilt, d]:.0f}" for d in DIAMETERS))
        for name, tilt in product(GROUNDS, tilts)
    ]
    headings = ("ground", *(f"{d} px" for d in DIAMETERS))
    console.print(table(f"{run.name}: % found on the first frame, by diameter", headings, rows))
    return [*_judge_size(shares), *(_judge_hard(run, 2 * frames, *case) for case in HARD)]


def _judge_size(shares: dict[tuple[str, int, int], float]) -> Iterator[Verdict]:
    for (name, tilt), smallest in SMALLEST.items():
        worst = min(shares[name, tilt, d] for d in DIAMETERS if d >= smallest)
        what = f"recall on {name}, {tilt} degrees, {smallest} px and more"
        yield Verdict(what, f"{100 * worst:.1f} %", f">= {100 * RECALL:g} %", worst >= RECALL)


def _judge_hard(run: Run, frames: int, what: str, picture: Picture, goal: float) -> Verdict:
    share = recall(run, frames, picture)
    return Verdict(what, f"{100 * share:.1f} % found", f">= {100 * goal:g} %", share >= goal)
