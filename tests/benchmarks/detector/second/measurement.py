# SPDX-License-Identifier: BSD-3-Clause
"""The detector on a second generator of pictures, beside the one that its thresholds were chosen with.

The second generator shares no code with the first (`pictures`, `camera_node.simulation.sensor`): exact coverage of
projected polygons, a lens with aberrations, physical light and cameras with other curves. Both are measured alike:
twenty prints of random size in a picture, tilted by up to 60 degrees, first frame, default settings, a detector that
has seen three pictures of the camera.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import msgspec
import numpy as np
from rich.console import Console

from camera_node.detection.detector import Detector
from camera_node.detection.disc_pose import locate_all
from camera_node.foundation.arrays import Array, Grey
from camera_node.geometry.lens import Lens
from camera_node.simulation.sensor import CLEAN, HARSH, MILD, Sensor
from tests.benchmarks.detector.cameras import FORGET, SIZES, acquainted
from tests.benchmarks.detector.lighting import NOISE, Disturb, even, gloss, soft_shadow
from tests.benchmarks.detector.pictures import Card, flat, grid, paste, sight_of
from tests.benchmarks.detector.recall import ground, occlude
from tests.benchmarks.detector.second import scene, surroundings
from tests.benchmarks.detector.second.camera import Camera
from tests.benchmarks.detector.second.print_geometry import FOCAL, INNER, SIZE, Print
from tests.benchmarks.detector.table import Run, Verdict, table
from tests.camera_node.tracing import Sight, ellipse_of, trace

BEND = 0.02
COMA = 0.4  # waves in the corners of the picture
NEAR = 0.2  # distance from the true centre at which a print counts as found, diameters
FAR_OFF = 3.0  # mean squared error over the claim
EXACT = 1e-3  # pixels
MONOCHROME = Camera()
LENS = Lens(width=SIZE[1], height=SIZE[0], fx=FOCAL, fy=FOCAL, cx=(SIZE[1] - 1) / 2, cy=(SIZE[0] - 1) / 2)


@dataclass(frozen=True)
class Truth:
    """One print: its disc's own centre, its outer ellipse's centre (2,) and axes (2,), pixels, and its normal (3,)."""

    uv: Array
    diameter: float
    centre: Array
    axes: Array
    normal: Array


Picture = tuple[Grey, list[Truth]]
Generator = Callable[[tuple[int, int], np.random.Generator], Picture]


@dataclass(frozen=True)
class Second:
    """A condition of the second generator; a bar covers the share `cover` of each disc, `gain` multiplies the light."""

    camera: Camera = MONOCHROME
    light: scene.Light = "room"
    grounds: tuple[surroundings.Ground, ...] = (surroundings.even,)
    square: bool = False
    curl: float = 0.0
    coma: float = 0.0
    ratio: float = INNER
    gain: float = 1.0
    cover: float = 0.0

    def show(self, band: tuple[int, int], rng: np.random.Generator) -> Picture:
        """A picture of twenty prints of a band of sizes."""
        prints = [
            replace(card, ratio=self.ratio)
            for card in scene.draw_prints(band, rng, square=self.square, curl=self.curl)
        ]
        return self._expose(prints, rng), [_truth(card) for card in prints]

    def show_ground(self, rng: np.random.Generator) -> Grey:
        """A picture without prints."""
        return self._expose([], rng)

    def _expose(self, prints: list[Print], rng: np.random.Generator) -> Grey:
        return self.camera.expose(self.light_of(prints, rng), rng)

    def light_of(self, prints: list[Print], rng: np.random.Generator) -> Array:
        """The light (h, w) of prints on a ground that it draws, levels of 255."""
        there = scene.Scene.draw(self.grounds[rng.integers(len(self.grounds))], self.coma, rng)
        light = self.gain * scene.render(there, prints, self.light, rng)
        for card in prints if self.cover else []:
            occlude(light, Card(card.uv, card.diameter), self.cover, rng.uniform(-1, 1), rng)
        return light

    def acquaint(self, run: Run) -> Detector:
        """A detector that has seen three pictures of this camera, and tracks nothing."""
        detector, usual = run.make(), Second(self.camera)
        for seed in range(3):
            detector.detect(usual.show((20, 44), np.random.default_rng((8, seed)))[0])
        for _ in range(FORGET):
            detector.detect(np.full(SIZE, 120, np.uint8))
        return detector


@dataclass(frozen=True)
class First:
    """The same condition of the first generator, as in `cameras`, `lighting` and `bent`."""

    sensor: Sensor = CLEAN
    disturb: Disturb = even
    on: str = "even"
    bend: float = 0.0

    def show(self, band: tuple[int, int], rng: np.random.Generator) -> Picture:
        """A picture of twenty prints of a band of sizes."""

        def draw() -> tuple[float, float, float]:
            size, slant, azimuth = (rng.uniform(*limits) for limits in (band, (0, np.pi / 3), (0, 2 * np.pi)))
            return float(size), float(slant), float(azimuth)

        cards = [Card(uv, *draw()) for uv in grid(20, SIZE, rng)]
        sights = [replace(sight_of(card, (SIZE[1], SIZE[0])), bend=self.bend) for card in cards]
        if self.bend:
            light = _traced(sights)
        else:
            light = paste(flat(SIZE, 90.0) if self.on == "even" else ground(self.on, rng), cards)
        truths = [
            Truth(np.array(card.uv), card.diameter, *ellipse_of(sight), sight.normal)
            for card, sight in zip(cards, sights, strict=True)
        ]
        return self.sensor.expose(self.disturb(light, cards, rng), rng), truths

    def acquaint(self, run: Run) -> Detector:
        """A detector that has learned this camera, and tracks nothing."""
        return acquainted(run, self.sensor)


CONDITIONS: dict[str, tuple[First | None, Second]] = {
    "clean": (First(), Second()),
    "mild": (First(MILD), Second(Camera(falls_off=True, tone="srgb", jpeg=75))),
    "shoulder": (None, Second(Camera(falls_off=True, tone="shoulder", jpeg=75))),
    "harsh": (First(HARSH), Second(Camera(falls_off=True, tone="filmic", colour=True, jpeg=75))),
    "shadow": (First(NOISE, soft_shadow), Second(light="shadow")),
    "gloss": (First(NOISE, gloss), Second(light="gloss")),
    "bent": (First(NOISE, bend=BEND), Second(curl=BEND)),
    "textured": (First(on="clutter"), Second(grounds=surroundings.TEXTURES)),
    "textured, mild": (
        First(MILD, on="clutter"),
        Second(Camera(falls_off=True, tone="srgb", jpeg=75), grounds=surroundings.TEXTURES),
    ),
    "square card": (None, Second(square=True)),
    "coma": (None, Second(coma=COMA)),
}


@dataclass(frozen=True)
class Errors:
    """Share found, and mean squared errors over the claimed variance, for each coordinate.

    That of the normal counts two coordinates with the variance of the less certain one, so that at most 1 is due. It
    is that of the nearer of both solutions.
    """

    found: float
    centre: float
    size: float
    normal: float


def measure_cell(
    known: Detector, show: Generator, band: tuple[int, int], frames: int, seed: int = 0
) -> Errors:
    """Measure so many pictures of one condition and band."""
    rng = np.random.default_rng((*band, seed))
    rows, there = [], 0
    for _ in range(frames):
        picture, truths = show(band, rng)
        rows.append(_compare(known, picture, truths))
        there += len(truths)
    squared = np.concatenate(rows)
    if not len(squared):
        return Errors(0.0, np.nan, np.nan, np.nan)
    return Errors(len(squared) / there, *(float(mean) for mean in np.nanmean(squared, axis=0)))


def _compare(known: Detector, picture: Grey, truths: list[Truth]) -> Array:
    """(N, 3) squared errors over claims of centre, size and normal of the prints that are found in a picture."""
    found = known.adjusted().detect(picture)
    poses, rows = locate_all(found, LENS, 0.1), []
    for truth in truths:
        apart = np.linalg.norm(found.uv - truth.uv, axis=1)
        if apart.min(initial=np.inf) >= NEAR * truth.diameter:
            continue
        k = int(apart.argmin())
        off, by_size = found.uv[k] - truth.centre, np.array([1.0, 0.0, 1.0])  # the trace of the shape
        size = (found.axes_px[k].sum() - truth.axes.sum()) / 2
        angles = np.arccos(np.clip(poses.normal[k] @ truth.normal, -1, 1))
        near = int(angles.argmin())
        rows.append(
            (
                off @ np.linalg.solve(found.cov[k], off) / 2,
                size**2 / (by_size @ found.pose_cov[k, 2:5, 2:5] @ by_size),
                (angles[near] / poses.normal_sigma[k, near]) ** 2 / 2,
            )
        )
    return np.array(rows).reshape(-1, 3)


def _truth(card: Print) -> Truth:
    return Truth(np.array(card.uv), card.diameter, *card.ellipse(), card.axes[:, 2])


def _traced(sights: list[Sight]) -> Array:
    """Bent prints, each traced with the ground around it: every pixel belongs to the nearest one."""
    out = flat(SIZE, 90.0)
    for sight in sights:
        (u, v), lens = sight.uv, sight.lens
        u0, v0 = max(0, round(u) - 52), max(0, round(v) - 59)
        u1, v1 = min(SIZE[1], u0 + 105), min(SIZE[0], v0 + 119)
        moved = msgspec.structs.replace(lens, width=u1 - u0, height=v1 - v0, cx=lens.cx - u0, cy=lens.cy - v0)
        out[v0:v1, u0:u1] = trace(replace(sight, lens=moved, uv=(u - u0, v - v0), ground=90.0), 4)
    return out


def false_detections(run: Run, frames: int) -> dict[tuple[str, str], int]:
    """Roundels found in pictures of grounds without any, by camera and ground."""
    counts = {}
    for name in ("clean", "mild", "harsh"):
        camera = CONDITIONS[name][1].camera
        known = Second(camera).acquaint(run)
        for texture in surroundings.TEXTURES:
            shown, rng = Second(camera, grounds=(texture,)), np.random.default_rng(6)
            counts[name, texture.__name__] = sum(
                len(known.adjusted().detect(shown.show_ground(rng))) for _ in range(frames)
            )
    return counts


def measure(run: Run, console: Console) -> list[Verdict]:
    """Print both generators' tables, and return the verdicts on the second one and on the generator itself."""
    frames, verdicts = 10 if run.thorough else 3, []
    off, amount = scene.moment_errors(200 if run.thorough else 40)
    rows = []
    for name, sources in CONDITIONS.items():
        known = [source and source.acquaint(run) for source in sources]
        for band in SIZES:
            what = f"{name}, {band[0]} to {band[1]} px"
            pair = [
                source and detector and measure_cell(detector, source.show, band, frames)
                for source, detector in zip(sources, known, strict=True)
            ]
            rows.append((what, *(text for e in pair for text in _texts(e))))
            console.print(*rows[-1])
            if pair[1]:
                verdicts.append(_judge(what, pair[1]))
    headings = (
        "",
        *(f"{what} {k}" for k in ("1st", "2nd") for what in ("found %", "centre²", "size²", "normal²")),
    )
    title = f"{run.name}: first and second generator, squared errors over claims"
    console.print(table(title, headings, rows))
    wrong = false_detections(run, frames)
    rows = [(f"{camera}, {texture}", count) for (camera, texture), count in wrong.items()]
    console.print(table(f"{run.name}: false detections on {frames} grounds", ("", "count"), rows))
    exact = Verdict(
        "second generator: centroid of light", f"{off:.5f} px, amount {amount:.0e}", "0.001 px", off < EXACT
    )
    none = Verdict(
        "second generator: false detections", str(sum(wrong.values())), "0", not sum(wrong.values())
    )
    return [exact, *verdicts, none]


def _texts(e: Errors | None) -> tuple[str, ...]:
    if e is None:
        return ("-",) * 4
    return f"{100 * e.found:.0f}", f"{e.centre:.1f}", f"{e.size:.1f}", f"{e.normal:.1f}"


def _judge(what: str, e: Errors) -> Verdict:
    worst = max(e.centre, e.size, e.normal)
    return Verdict(
        f"second generator: {what}, squared error over claim",
        f"{worst:.1f}",
        f"<= {FAR_OFF:g}",
        worst <= FAR_OFF,
    )
