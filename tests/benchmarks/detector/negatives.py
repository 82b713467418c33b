# SPDX-License-Identifier: BSD-3-Clause
"""False positives on images without roundels: letters, rings of other ratios, pages of text, photographs."""

from collections.abc import Callable, Iterator

import cv2
import numpy as np
from rich.console import Console

from tests.benchmarks.detector.photographs import photographs
from tests.benchmarks.detector.pictures import Grey, dead_leaves, expose
from tests.benchmarks.detector.table import Run, Verdict, table

SIZE = (480, 640)
FONTS = (
    cv2.FONT_HERSHEY_SIMPLEX,
    cv2.FONT_HERSHEY_DUPLEX,
    cv2.FONT_HERSHEY_COMPLEX,
    cv2.FONT_HERSHEY_TRIPLEX,
    cv2.FONT_HERSHEY_SCRIPT_SIMPLEX,
    cv2.FONT_HERSHEY_SCRIPT_COMPLEX,
)
COMMON = (0.6, 0.41)  # inner ratios of the usual prints
OTHER_RATIOS = (0.15, 0.2, 0.8, 0.85, 0.9)  # more than the tolerance of 0.1 away from 0.6 and 0.41


def _seen(image: np.ndarray, rng: np.random.Generator) -> Grey:
    """The image with the blur of a lens and the noise of a sensor."""
    blurred = np.asarray(
        cv2.GaussianBlur(image.astype(np.float32), (0, 0), float(rng.uniform(0.5, 1.2))), float
    )
    return expose(blurred, float(rng.uniform(1, 3)), rng)


def letters(n: int) -> Iterator[Grey]:
    """Pages of the letters o O 0 Q 8 in OpenCV's fonts, of 8 to 100 px and any weight."""
    for seed in range(n):
        rng = np.random.default_rng(seed)
        page = np.full(SIZE, int(rng.integers(150, 240)), np.uint8)
        y = 5.0
        while y < SIZE[0]:
            scale = float(rng.uniform(0.4, 3.5))
            y += 28 * scale
            weight = int(rng.integers(1, max(2, round(4 * scale))))
            text = "".join(rng.choice(list("oOoO0Q8"), 40))
            cv2.putText(
                page,
                text,
                (4, int(y)),
                FONTS[rng.integers(len(FONTS))],
                scale,
                int(rng.integers(0, 70)),
                weight,
                cv2.LINE_AA,
            )
        yield _seen(page, rng)


def print_letters(n: int) -> Iterator[Grey]:
    """Pages of o Q 8 like printed ones: two ellipses of different shape (strokes of two widths), with tails."""
    for seed in range(n):
        rng = np.random.default_rng(seed)
        page = np.full(SIZE, int(rng.integers(150, 240)), np.uint8)
        for y in range(30, SIZE[0] - 30, 60):
            for x in range(30, SIZE[1] - 30, 60):
                _print_letter(page, (x, y), rng)
        yield _seen(page, rng)


def _print_letter(page: np.ndarray, at: tuple[int, int], rng: np.random.Generator) -> None:
    """The ratio is that of a roundel in one direction; in both directions only with a tail (Q) or a second ring (8)."""
    white, ink = int(page[0, 0]), int(rng.integers(0, 70))
    height, shape = rng.uniform(6, 26), rng.choice(list("oQ8"))
    width = height * rng.uniform(0.75, 1.0)
    thin, thick = rng.uniform(0.1, 0.25), rng.uniform(0.45, 0.7)
    inner = (height * (1 - thin), width * (1 - thick)) if shape == "o" else (height * 0.6, width * 0.6)
    offsets = (-0.9 * height, 0.9 * height) if shape == "8" else (0.0,)
    for offset in offsets:
        centre = (16 * at[0], round(16 * (at[1] + offset)))
        cv2.ellipse(page, centre, (round(16 * width), round(16 * height)), 0, 0, 360, ink, -1, cv2.LINE_AA, 4)
    for offset in offsets:
        centre = (16 * at[0], round(16 * (at[1] + offset)))
        cv2.ellipse(
            page, centre, (round(16 * inner[1]), round(16 * inner[0])), 0, 0, 360, white, -1, cv2.LINE_AA, 4
        )
    if shape == "Q":
        start, end = ((round(at[0] + k * width), round(at[1] + k * height)) for k in (0.3, 1.1))
        cv2.line(page, start, end, ink, max(2, round(0.3 * height)), cv2.LINE_AA)


def rings(n: int) -> Iterator[Grey]:
    """Rings of 12 to 60 px with ratios that no print has, frontal and tilted."""
    for seed in range(n):
        rng = np.random.default_rng(seed)
        page = np.full(SIZE, int(rng.integers(150, 240)), np.uint8)
        for y in range(35, SIZE[0] - 30, 70):
            for x in range(35, SIZE[1] - 30, 70):
                a = rng.uniform(6, 30)
                b, turn, ratio = a * rng.uniform(0.6, 1), float(rng.uniform(0, 180)), rng.choice(OTHER_RATIOS)
                for scale, level in ((1.0, int(rng.integers(0, 70))), (ratio, int(page[0, 0]))):
                    axes = (round(16 * scale * a), round(16 * scale * b))
                    cv2.ellipse(page, (16 * x, 16 * y), axes, turn, 0, 360, level, -1, cv2.LINE_AA, 4)
        yield _seen(page, rng)


def text_pages(n: int) -> Iterator[Grey]:
    """Pages of random words."""
    for seed in range(n):
        rng = np.random.default_rng(seed)
        page = np.full(SIZE, 225, np.uint8)
        scale, font, y = float(rng.uniform(0.3, 1.2)), FONTS[rng.integers(4)], 0
        while (y := y + int(30 * scale) + 4) < SIZE[0]:
            text = "".join(rng.choice(list("abcdefghijklmnopqrstuvwxyzABDGOPQR0689 @&%  "), 120))
            cv2.putText(page, text, (5, y), font, scale, 30, 1 + int(scale), cv2.LINE_AA)
        yield _seen(page, rng)


def clutter(n: int) -> Iterator[Grey]:
    """Dead leaves."""
    for seed in range(n):
        rng = np.random.default_rng(seed)
        yield _seen(dead_leaves(SIZE, rng), rng)


def measure(run: Run, console: Console) -> list[Verdict]:
    """Print the numbers of false positives and return the verdicts on the goals."""
    n = 200 if run.thorough else 20
    kinds: dict[str, tuple[Callable[[int], Iterator[Grey]], int]] = {
        "letters o O 0 Q 8": (letters, n),
        "printed letters": (print_letters, n),
        "rings of other ratios": (rings, n),
        "pages of text": (text_pages, n),
        "dead leaves": (clutter, n),
        "photographs": (photographs, 1000 if run.thorough else 300),
    }
    counts = {
        what: [len(run.make().adjusted(inner_ratios=COMMON).detect(image)) for image in make(number)]
        if make is rings  # which no other print has
        else [len(run.make().detect(image)) for image in make(number)]
        for what, (make, number) in kinds.items()
    }
    rows = [(what, len(found), sum(found), sum(k > 0 for k in found)) for what, found in counts.items()]
    console.print(table(f"{run.name}: false positives", ("pictures", "number", "found", "in pictures"), rows))
    return [
        Verdict(
            f"false positives, {len(found)} {what}", str(sum(found)), "0", sum(found) == 0 if found else None
        )
        for what, found in counts.items()
    ]
