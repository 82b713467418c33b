# SPDX-License-Identifier: BSD-3-Clause
"""Moving roundels: shares found when tracked and on a first frame, and false positives after one disappears."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from itertools import product

import cv2
import numpy as np
from rich.console import Console

from camera_node.detection.detector import Detector
from camera_node.foundation.arrays import Array
from tests.benchmarks.detector.negatives import clutter, letters, text_pages
from tests.benchmarks.detector.photographs import photographs
from tests.benchmarks.detector.pictures import NOISE, Card, Grey, dead_leaves, expose, flat, paste
from tests.benchmarks.detector.table import MakeDetector, Run, Verdict, table

SIZE = (300, 400)
DIAMETER = 32.0
LENGTHS = (8, 16, 24)  # pixels of motion during the exposure, at full speed
EXPOSED = 0.5  # exposure over the frame interval
RAMP = 4  # frames from rest to full speed
FOUND = 0.95


def blur_by_motion(image: Array, motion: Array) -> Array:
    """The image moved by `motion` (2,), pixels, during its exposure: the mean of many shifted images."""
    h, w = image.shape
    times = (np.arange(max(2, int(4 * np.linalg.norm(motion)))) + 0.5)[:, None]
    shifts = (times / len(times) - 0.5) * motion
    moved = [
        cv2.warpAffine(image, np.array([[1, 0, u], [0, 1, v]]), (w, h), borderMode=cv2.BORDER_REPLICATE)
        for u, v in shifts
    ]
    return np.mean(moved, axis=0)


def moving(ground: Array, card: Card, motion: Array) -> Array:
    """A card that moves over a still ground: the light of each in proportion to its visible share."""
    light = blur_by_motion(paste(flat(SIZE, 0.0), [card]), motion)
    hidden = 1 - blur_by_motion(paste(flat(SIZE, 1.0), [card], dark=0.0, bright=0.0), motion)
    return light + np.asarray(cv2.GaussianBlur(ground, (0, 0), 0.7)) * (1 - hidden)


@dataclass(frozen=True)
class Shot:
    """One frame of a sequence, and the card at mid-exposure."""

    image: Grey
    card: Card
    at_full_speed: bool


def sequence(ground: Array, length: float, rng: np.random.Generator) -> Iterator[Shot]:
    """A card that accelerates from rest to a speed of `length` pixels per exposure."""
    turn = rng.uniform(0, 2 * np.pi)
    ahead = np.array([np.cos(turn), np.sin(turn)])
    card = Card((0.0, 0.0), DIAMETER, float(rng.uniform(0, 0.5)), float(rng.uniform(0, 2 * np.pi)))
    speeds = length / EXPOSED * np.minimum(1, np.arange(RAMP + 3) / RAMP)
    along = np.cumsum(speeds) - np.sum(speeds) / 2
    for speed, s in zip(speeds, along, strict=True):
        at = np.array([SIZE[1], SIZE[0]]) / 2 + s * ahead
        card = replace(card, uv=(float(at[0]), float(at[1])))
        clean = moving(ground, card, EXPOSED * speed * ahead)
        yield Shot(expose(clean, NOISE, rng), card, bool(speed == speeds[-1]))


@dataclass(frozen=True)
class Shares:
    """Shares of the frames at full speed in which a tracking detector, and a new one, find the card."""

    tracked: float
    first: float


def finds(detector: Detector, shot: Shot) -> bool:
    """Whether a roundel is found within a tenth of the diameter from the card's centre."""
    uv = detector.detect(shot.image).uv
    return bool((np.linalg.norm(uv - shot.card.uv, axis=1) < 0.1 * DIAMETER).any())


def measure_motion(run: Run, kind: str, length: float, sequences: int) -> Shares:
    """Measure sequences with one length of motion at full speed, on white or on clutter."""
    tracked, first = [], []
    for seed in range(sequences):
        rng, detector = np.random.default_rng((seed, int(length))), run.make()
        ground = flat(SIZE, 190.0) if kind == "white" else dead_leaves(SIZE, rng)
        for shot in sequence(ground, length, rng):
            found = finds(detector, shot)
            if shot.at_full_speed:
                tracked.append(found)
                first.append(finds(run.make(), shot))
    return Shares(float(np.mean(tracked)), float(np.mean(first)))


def appear_after_disappearance(make: MakeDetector, page: Grey, seed: int) -> int:
    """The number of false positives on a page from which a roundel has just disappeared, beside those of the page."""
    h, w = page.shape
    rng, detector = np.random.default_rng(seed), make()
    uv = rng.uniform((50, 50), (w - 50, h - 50))
    card = Card((float(uv[0]), float(uv[1])), float(rng.uniform(16, 44)))
    detector.detect(expose(paste(page.astype(float), [card]), 1, rng))
    before = {tuple(at) for at in make().detect(page).uv.round().tolist()}
    return sum(tuple(at) not in before for at in detector.detect(page).uv.round().tolist())


def measure(run: Run, console: Console) -> list[Verdict]:
    """Print the shares by length and ground, and return the verdicts on the goals."""
    n = 60 if run.thorough else 12
    cells = list(product(("white", "clutter"), LENGTHS))
    shares: dict[tuple[str, int], Shares] = {cell: measure_motion(run, *cell, n) for cell in cells}
    rows = [
        (f"{kind}, {length} px", f"{100 * s.tracked:.0f}", f"{100 * s.first:.0f}")
        for (kind, length), s in shares.items()
    ]
    title = f"{run.name}: % found of {DIAMETER:g} px that move during the exposure"
    console.print(table(title, ("ground, motion", "tracked", "first frame"), rows))
    return [*_judge(shares), *_judge_disappearance(run, 5 * n)]


def _judge(shares: dict[tuple[str, int], Shares]) -> Iterator[Verdict]:
    goal = f">= {100 * FOUND:g} %"
    for length in LENGTHS:
        for what in ("tracked", "first"):
            share = float(np.mean([getattr(s, what) for (_, px), s in shares.items() if px == length]))
            name = f"motion of {length} px on {DIAMETER:g} px, {what}"
            yield Verdict(name, f"{100 * share:.1f} %", goal, share >= FOUND)


def _judge_disappearance(run: Run, n: int) -> Iterator[Verdict]:
    kinds: dict[str, Callable[[int], Iterator[Grey]]] = {
        "letters": letters,
        "text": text_pages,
        "dead leaves": clutter,
        "photographs": photographs,
    }
    for what, pages in kinds.items():
        found = sum(appear_after_disappearance(run.make, page, seed) for seed, page in enumerate(pages(n)))
        yield Verdict(
            f"false positives, {n} {what}, after a roundel disappeared", str(found), "0", found == 0
        )
