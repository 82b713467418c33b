# SPDX-License-Identifier: BSD-3-Clause
"""Measures codes: shares of certain names, wrong names, headings, false names: `python -m tests.benchmarks.codes`."""

from dataclasses import dataclass, field

import numpy as np
import tyro
from rich.console import Console

from camera_node.detection.detector import Detector
from camera_node.foundation.arrays import Array
from camera_node.geometry import codes
from camera_node.simulation.sensor import SENSORS, SensorName
from tests.benchmarks.detector.negatives import clutter, letters, text_pages
from tests.benchmarks.detector.photographs import photographs
from tests.benchmarks.detector.pictures import Card, grid, missed, paste, rotation_of
from tests.benchmarks.detector.recall import SIZE, ground
from tests.benchmarks.detector.table import table

CELLS = {0: (11, 12, 14, 16, 20), 45: (12, 14, 16, 20), 60: (14, 16, 20, 24)}  # diameters by tilt, degrees
FRAMES = (1, 10)
NEAR = 0.2  # distance from the true centre at which a card counts as found, diameters


@dataclass
class Count:
    """Of cards: found, named, wrongly named; errors and claims of headings, radians."""

    shown: int = 0
    found: int = 0
    named: int = 0
    wrong: int = 0
    errors: list[float] = field(default_factory=list)
    sigmas: list[float] = field(default_factory=list)

    def row(self) -> tuple[str, ...]:
        """Percentages of cards, wrong names, RMS of headings and of their claims in degrees."""
        rms = (
            np.degrees(np.sqrt(np.mean(np.square(x)))) if x else np.nan for x in (self.errors, self.sigmas)
        )
        shares = (100 * n / self.shown for n in (self.found, self.named))
        return *(f"{x:.1f}" for x in shares), str(self.wrong), *(f"{x:.2f}" for x in rms)


def cards(diameter: float, tilt_deg: float, count: int, rng: np.random.Generator) -> list[Card]:
    """Cards with random codes, turns and directions of tilt."""
    return [
        Card(
            uv,
            diameter,
            float(np.radians(tilt_deg)),
            float(rng.uniform(0, 2 * np.pi)),
            card=codes.CARD,
            code=int(rng.integers(1, len(codes.words()) + 1)),
            spin=float(rng.uniform(0, 2 * np.pi)),
        )
        for uv in grid(count, SIZE, rng)
    ]


def compare(
    image_cards: list[Card], detector: Detector, light: Array, camera: SensorName, frames: int
) -> Count:
    """Detect the cards in so many pictures of the same light, and judge the last one."""
    rng = np.random.default_rng(len(image_cards))
    found = detector.detect(SENSORS[camera].expose(light, rng))
    for _ in range(frames - 1):
        found = detector.detect(SENSORS[camera].expose(light, rng))
    count = Count(len(image_cards), len(image_cards) - missed(image_cards, found.uv))
    for card in image_cards:
        apart = np.linalg.norm(found.uv - card.uv, axis=1)
        if not apart.min(initial=np.inf) < NEAR * card.diameter:
            continue
        roundel = found[int(apart.argmin())]
        if roundel.id is None:
            continue
        count.named += 1
        count.wrong += roundel.id != card.code
        if np.isfinite(roundel.rotation_rad):
            off = roundel.rotation_rad - rotation_of(card, SIZE)
            count.errors.append(float((off + np.pi) % (2 * np.pi) - np.pi))
            count.sigmas.append(roundel.rotation_sigma)
    return count


@dataclass(frozen=True)
class Benchmark:
    """Measure codes on clutter, by tilt, diameter and number of frames, and false names without codes."""

    camera: SensorName = "mild"
    """clean, mild or harsh."""
    count: int = 96
    """Cards of a cell, 48 in a picture."""
    pictures: int = 200
    """Pictures without codes of each kind."""

    def run(self) -> None:
        """Print both tables."""
        console, rows = Console(width=120), []
        for tilt, diameters in CELLS.items():
            for diameter in diameters:
                for frames in FRAMES:
                    total = self._cell(diameter, tilt, frames)
                    rows.append((f"{tilt} degrees, {diameter} px, {frames} frames", *total.row()))
                    console.print(*rows[-1])
        headings = ("", "% found", "% named", "wrong", "heading, deg", "claimed")
        console.print(table(f"{self.camera} camera, on clutter", headings, rows))
        rows = []
        for name, kind in (
            ("photographs", photographs),
            ("dead leaves", clutter),
            ("letters", letters),
            ("pages of text", text_pages),
        ):
            found = named = shown = 0
            for image in kind(self.pictures):
                seen = Detector().detect(image)
                shown, found, named = shown + 1, found + len(seen), named + int((seen.id > 0).sum())
            rows.append((name, str(shown), str(found), str(named)))
        console.print(table("without codes", ("", "pictures", "roundels", "names"), rows))

    def _cell(self, diameter: float, tilt: float, frames: int) -> Count:
        total = Count()
        for seed in range(max(1, self.count // 48)):
            rng = np.random.default_rng((seed, int(diameter), int(tilt)))
            shown = cards(diameter, tilt, 48, rng)
            one = compare(shown, Detector(), paste(ground("clutter", rng), shown), self.camera, frames)
            total = Count(*(getattr(total, name) + getattr(one, name) for name in Count.__dataclass_fields__))
        return total


if __name__ == "__main__":
    tyro.cli(Benchmark, prog="tests.benchmarks.codes").run()
