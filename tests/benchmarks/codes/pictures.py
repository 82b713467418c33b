# SPDX-License-Identifier: BSD-3-Clause
"""Coded and plain roundels in the pictures of both generators: which are found, and which names and headings are read.

The second generator (`tests/benchmarks/detector/second`) shares no code with the first. Both draw the same numbers for
plain and for coded roundels, so that they differ in card and code only.
"""

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field, replace

import numpy as np

from camera_node.detection.detector import Detector
from camera_node.detection.roundels import DetectedRoundels
from camera_node.foundation.arrays import Array, Grey
from camera_node.geometry import codes
from camera_node.simulation.sensor import CLEAN, HARSH, MILD, Sensor
from tests.benchmarks.detector.negatives import clutter, letters, text_pages
from tests.benchmarks.detector.photographs import views
from tests.benchmarks.detector.pictures import Card, grid, paste, rotation_of
from tests.benchmarks.detector.recall import SIZE, ground
from tests.benchmarks.detector.second import scene, surroundings
from tests.benchmarks.detector.second.camera import Camera
from tests.benchmarks.detector.second.measurement import NEAR, Second

CELLS = {0: (11, 12, 14, 16, 20), 45: (12, 14, 16, 20), 60: (14, 16, 20, 24)}  # diameters by tilt, degrees
FRAMES = (1, 10)
SMALL, SMALL_TILT = (11.0, 14.0), (0.0, 45.0)  # pixels and degrees in which recall is compared
PLAIN_CARD = 9 / 7
CARDS = 48  # in a picture of the first generator; one of the second has 20
DOT_GAIN = 0.01  # outer radii: 0.25 mm on a disc of 50 mm
Band = tuple[float, float]


@dataclass(frozen=True)
class Shown:
    """One roundel in a picture: its disc's centre and diameter, pixels, code, and `Roundel.rotation_rad` in truth."""

    uv: Array
    diameter: float
    code: int
    rotation: float


@dataclass(frozen=True)
class First:
    """A camera of the first generator, on clutter."""

    camera: Sensor

    def show(
        self, diameters: Band, tilts: Band, coded: bool, rng: np.random.Generator
    ) -> tuple[list[Shown], Iterator[Grey]]:
        """Roundels, and pictures of them that differ in noise."""
        cards = [
            Card(
                uv,
                float(rng.uniform(*diameters)),
                float(np.radians(rng.uniform(*tilts))),
                float(rng.uniform(0, 2 * np.pi)),
                card=codes.CARD if coded else PLAIN_CARD,
                code=_code(rng) * coded,
                spin=float(rng.uniform(0, 2 * np.pi)),
            )
            for uv in grid(CARDS, SIZE, rng)
        ]
        light = paste(ground("clutter", rng), cards)
        shown = [Shown(np.array(c.uv), c.diameter, c.code, rotation_of(c, SIZE)) for c in cards]
        return shown, (self.camera.expose(light, rng) for _ in range(FRAMES[-1]))


@dataclass(frozen=True)
class Other:
    """A camera of the second generator, on textures, and how its roundels are printed."""

    camera: Camera
    dot_gain: float = 0.0
    screened: bool = False

    def show(
        self, diameters: Band, tilts: Band, coded: bool, rng: np.random.Generator
    ) -> tuple[list[Shown], Iterator[Grey]]:
        """Roundels, and pictures of them that differ in noise."""
        prints = [
            replace(
                drawn,
                diameter=float(rng.uniform(*diameters)),
                tilt=float(np.radians(rng.uniform(*tilts))),
                card=codes.CARD if coded else PLAIN_CARD,
                code=_code(rng) * coded,
                spin=float(rng.uniform(0, 2 * np.pi)),
                dot_gain=self.dot_gain,
                screened=self.screened,
            )
            for drawn in scene.draw_prints((1, 2), rng)
        ]
        light = Second(self.camera, grounds=surroundings.TEXTURES).light_of(prints, rng)
        shown = [Shown(np.array(p.uv), p.diameter, p.code, p.rotation) for p in prints]
        return shown, (self.camera.expose(light, rng) for _ in range(FRAMES[-1]))


MILD_CAMERA = Camera(falls_off=True, tone="srgb", jpeg=75)
SCENES: dict[str, First | Other] = {
    "first, clean": First(CLEAN),
    "first, mild": First(MILD),
    "first, harsh": First(HARSH),
    "second, clean": Other(Camera()),
    "second, mild": Other(MILD_CAMERA),
    "second, harsh": Other(Camera(falls_off=True, tone="filmic", colour=True, jpeg=75)),
    "second, mild, dot gain": Other(MILD_CAMERA, dot_gain=DOT_GAIN),
    "second, mild, half-tone": Other(MILD_CAMERA, screened=True),
}
SIZES = ("first, mild", "second, mild")  # whose sizes and slants are measured


@dataclass
class Count:
    """Of roundels: shown, found, named, wrongly named; errors of headings, radians, and over their claims."""

    shown: int = 0
    found: int = 0
    named: int = 0
    wrong: int = 0
    errors: list[float] = field(default_factory=list)
    over_claims: list[float] = field(default_factory=list)

    def add(self, found: DetectedRoundels, shown: list[Shown]) -> None:
        """Compare what was detected in a picture."""
        for one in shown:
            self.shown += 1
            apart = np.linalg.norm(found.uv - one.uv, axis=1)
            if not apart.min(initial=np.inf) < NEAR * one.diameter:
                continue
            self.found += 1
            roundel = found[int(apart.argmin())]
            self.named += roundel.id is not None
            self.wrong += roundel.id is not None and roundel.id != one.code
            if roundel.id == one.code and np.isfinite(roundel.rotation_rad):
                off = (roundel.rotation_rad - one.rotation + np.pi) % (2 * np.pi) - np.pi
                self.errors.append(float(off))
                self.over_claims.append(float(off / roundel.rotation_sigma))

    @property
    def heading(self) -> tuple[str, str]:
        """RMS error, degrees, and mean squared error over the claim."""
        rms, squared = (
            np.sqrt(np.mean(np.square(x))) if x else np.nan for x in (self.errors, self.over_claims)
        )
        return f"{np.degrees(rms):.2f}", f"{squared**2:.2f}"

    def share(self, part: int) -> str:
        """Of those shown, in percent."""
        return f"{100 * part / self.shown:.1f}"


def measure(
    source: First | Other, diameters: Band, tilts: Band, coded: bool, count: int, frames: int
) -> list[Count]:
    """Counts after the first and after `frames` frames of a fresh detector, of `count` roundels or more."""
    first, last, seed = Count(), Count(), 0
    while last.shown < count:
        rng = np.random.default_rng((seed, *(int(10 * x) for x in (*diameters, *tilts))))
        shown, pictures = source.show(diameters, tilts, coded, rng)
        detector = Detector()
        for k, picture in zip(range(frames), pictures, strict=False):
            found = detector.detect(picture)
            if k in (0, frames - 1):
                (first if k == 0 else last).add(found, shown)
            if k == frames - 1 == 0:
                last = first
        seed += 1
    return [first, last]


def small_row(name: str, count: int) -> tuple[str, ...]:
    """Recall of plain and of coded roundels in the first picture, and what is read of these."""
    plain, coded = (measure(SCENES[name], SMALL, SMALL_TILT, c, count, 1)[0] for c in (False, True))
    shares = (plain.share(plain.found), coded.share(coded.found), coded.share(coded.named))
    return name, *shares, str(coded.wrong + plain.named), *coded.heading


def size_row(name: str, tilt: float, diameter: float, count: int) -> tuple[str, ...]:
    """What is found and read of roundels of one size and tilt, after one frame and after ten."""
    plain, coded = (
        measure(SCENES[name], (diameter, diameter), (tilt, tilt), c, count, FRAMES[-1]) for c in (False, True)
    )
    return (
        f"{name}, {tilt} degrees, {diameter} px",
        *(", ".join(x.share(x.found) for x in counts) for counts in (plain, coded)),
        ", ".join(x.share(x.named) for x in coded),
        str(sum(x.wrong for x in coded) + sum(x.named for x in plain)),
        *coded[-1].heading,
    )


def names_without_codes(pictures: int) -> Iterator[tuple[str, ...]]:
    """By kind of picture without roundels: pictures, roundels found, and names."""
    of_views = Counter[str]()
    for name, images in (
        ("views", views(of_views)),
        ("dead leaves", clutter(pictures)),
        ("letters", letters(pictures)),
        ("pages of text", text_pages(pictures)),
    ):
        found = named = shown = 0
        for image in images:
            seen = Detector().detect(image)
            shown, found, named = shown + 1, found + len(seen), named + int((seen.id > 0).sum())
        what = f"{name} of {of_views['photographs']} photographs" if name == "views" else name
        yield what, str(shown), str(found), str(named)


def _code(rng: np.random.Generator) -> int:
    return int(rng.integers(1, len(codes.words()) + 1))
