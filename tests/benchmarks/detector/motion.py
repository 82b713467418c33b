# SPDX-License-Identifier: BSD-3-Clause
"""Roundels that move while they are exposed: share found, tracked and on a first frame, error, and what goes away."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from itertools import product

import cv2
import numpy as np
from rich.console import Console

from camera_node.arrays import Array
from camera_node.detection.detector import Detector
from tests.benchmarks.detector.negatives import clutter, letters, text_pages
from tests.benchmarks.detector.photographs import photographs
from tests.benchmarks.detector.pictures import NOISE, Card, Grey, dead_leaves, expose, flat, paste
from tests.benchmarks.detector.table import Run, Verdict, table

SIZE = (300, 400)
DIAMETER = 32.0
SMEARS = (8, 16, 24)  # pixels, at full speed
EXPOSED = 0.5  # share of the time between frames
RAMP = 4  # frames from rest to full speed
FOUND = 0.95


def smear(image: Array, way: Array) -> Array:
    """The picture moved by `way` (2,), pixels, during its exposure: the mean of many shifted ones."""
    h, w = image.shape
    times = (np.arange(max(2, int(4 * np.linalg.norm(way)))) + 0.5)[:, None]
    shifts = (times / len(times) - 0.5) * way
    moved = [
        cv2.warpAffine(image, np.array([[1, 0, u], [0, 1, v]]), (w, h), borderMode=cv2.BORDER_REPLICATE)
        for u, v in shifts
    ]
    return np.mean(moved, axis=0)


def moving(ground: Array, card: Card, way: Array) -> Array:
    """A card that moves over a ground that does not: the light of each, in proportion to what is seen of it."""
    light = smear(paste(flat(SIZE, 0.0), [card]), way)
    hidden = 1 - smear(paste(flat(SIZE, 1.0), [card], dark=0.0, bright=0.0), way)
    return light + np.asarray(cv2.GaussianBlur(ground, (0, 0), 0.7)) * (1 - hidden)


@dataclass(frozen=True)
class Shot:
    """One frame of a sequence, and the card in it in mid-exposure."""

    image: Grey
    card: Card
    at_full_speed: bool


def sequence(ground: Array, length: float, rng: np.random.Generator) -> Iterator[Shot]:
    """A card that starts from rest, so that at full speed it moves `length` pixels during an exposure."""
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
    """Of the frames at full speed: the share found by a detector that saw all frames before, and by a new one."""

    tracked: float
    first: float


def finds(detector: Detector, shot: Shot) -> bool:
    """Whether a roundel is found within a tenth of the diameter of the card's centre."""
    uv = detector.detect(shot.image).uv
    return bool((np.linalg.norm(uv - shot.card.uv, axis=1) < 0.1 * DIAMETER).any())


def measure_smear(run: Run, kind: str, length: float, sequences: int) -> Shares:
    """Sequences with one smear at full speed, on white or on clutter."""
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


def gone(run: Run, pages: Iterator[Grey]) -> int:
    """How many are found on pages from which a roundel has just gone."""
    found = 0
    for seed, page in enumerate(pages):
        h, w = page.shape
        rng, detector = np.random.default_rng(seed), run.make()
        uv = rng.uniform((50, 50), (w - 50, h - 50))
        card = Card((float(uv[0]), float(uv[1])), float(rng.uniform(16, 44)))
        detector.detect(expose(paste(page.astype(float), [card]), 1, rng))
        before = {tuple(at) for at in run.make().detect(page).uv.round().tolist()}
        found += sum(tuple(at) not in before for at in detector.detect(page).uv.round().tolist())
    return found


def measure(run: Run, console: Console) -> list[Verdict]:
    """Print the shares by smear and ground; the verdicts on the goal, and on what goes away."""
    n = 60 if run.thorough else 12
    cells = list(product(("white", "clutter"), SMEARS))
    shares: dict[tuple[str, int], Shares] = {cell: measure_smear(run, *cell, n) for cell in cells}
    rows = [
        (f"{kind}, {length} px", f"{100 * s.tracked:.0f}", f"{100 * s.first:.0f}")
        for (kind, length), s in shares.items()
    ]
    title = f"{run.name}: % found of {DIAMETER:g} px that move during the exposure"
    console.print(table(title, ("ground, smear", "tracked", "first frame"), rows))
    return [*_judge(shares), *_judge_gone(run, 5 * n)]


def _judge(shares: dict[tuple[str, int], Shares]) -> Iterator[Verdict]:
    goal = f">= {100 * FOUND:g} %"
    for length in SMEARS:
        for what in ("tracked", "first"):
            share = float(np.mean([getattr(s, what) for (_, px), s in shares.items() if px == length]))
            name = f"{length} px smear on {DIAMETER:g} px, {what}"
            yield Verdict(name, f"{100 * share:.1f} %", goal, share >= FOUND)


def _judge_gone(run: Run, n: int) -> Iterator[Verdict]:
    kinds: dict[str, Callable[[int], Iterator[Grey]]] = {
        "letters": letters,
        "text": text_pages,
        "dead leaves": clutter,
        "photographs": photographs,
    }
    for what, pages in kinds.items():
        found = gone(run, pages(n))
        yield Verdict(f"false positives, {n} {what}, a roundel gone", str(found), "0", found == 0)
