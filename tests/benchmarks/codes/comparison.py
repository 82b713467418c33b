# SPDX-License-Identifier: BSD-3-Clause
"""Coded roundels beside square tags of the same printed area, on the same scenes, each with its usual detector.

The area is that of the card, with the white that a print needs: a round card of 1.9 radii, and tags with a white module
around them. Sizes are sides of squares of that area. All are rendered by one function and seen by one camera.
"""

import importlib.util
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import lru_cache, partial

import cv2
import msgspec
import numpy as np

from camera_node.detection.detector import Detector
from camera_node.foundation.arrays import Array, Grey
from camera_node.geometry import codes
from camera_node.simulation.sensor import MILD
from tests.benchmarks.codes.pictures import NEAR
from tests.benchmarks.detector.pictures import Card, grid, sight_of
from tests.benchmarks.detector.recall import SIZE, ground, occlude
from tests.benchmarks.detector.table import milliseconds
from tests.camera_node.tracing import plane_points

PIECES = 6  # samples of a pixel in either direction
PRINTS = 20  # in a picture
INK, PAPER = 40.0, 190.0
SECONDS = 0.2  # in which a detector's time is measured
Shade = Callable[[int, Array], Array]  # -1 outside of the card, 0 for paper, 1 for ink
Names = list[tuple[int, Array]]  # what a detector reads: names and places (2,)


@dataclass(frozen=True)
class View:
    """How prints are seen: side, pixels; tilt, degrees; blur of the lens, pixels; share of the side that is covered."""

    side: float
    tilt: float = 0.0
    blur: float = 0.7
    cover: float = 0.0


VIEWS = {
    **{f"{side} px": View(side) for side in (16, 18, 20, 24, 28, 32, 40)},
    **{f"40 px, tilt of {tilt} degrees": View(40, tilt=tilt) for tilt in (45, 60, 70, 75)},
    **{f"40 px, blur of {blur} px": View(40, blur=blur) for blur in (1.5, 2.0, 3.0)},
    **{f"64 px, {share} % covered": View(64, cover=share / 100) for share in (5, 10, 20)},
}


@dataclass(frozen=True)
class Kind:
    """A kind of print: what is at points (N, 2) of its plane, its names, and its reader.

    A point (1, 0) is half a side to the right of the centre, (0, 1) half a side above it.
    """

    shade: Shade
    names: range
    reader: Callable[[], Callable[[Grey], Names]]


def roundel(code: int, points: Array) -> Array:
    """A coded roundel; its card has the area of the square."""
    card = 2 / np.sqrt(np.pi)
    x, y = points[:, 0] * (codes.CARD / card), points[:, 1] * (codes.CARD / card)
    r, angle = np.hypot(x, y), np.arctan2(y, x)
    tick = codes.black_share(code, angle, np.full(angle.shape, 1e-6)) > 0.5
    ink = (r < 1) & (r > 0.6) | (r > codes.INNER) & (r < codes.OUTER) & tick
    return np.where(r < codes.CARD, ink.astype(float), -1.0)


def square(dictionary: int, name: int, points: Array) -> Array:
    """A square tag with a white module around it."""
    ink = np.pad(_modules(dictionary, name), 1)
    cell = np.floor((points + 1) / 2 * len(ink)).astype(int)
    inside = ((cell >= 0) & (cell < len(ink))).all(axis=1)
    i, j = np.clip(cell, 0, len(ink) - 1).T
    return np.where(inside, ink[len(ink) - 1 - j, i], -1.0)


@lru_cache(maxsize=256)
def _modules(dictionary: int, name: int) -> Array:
    """The black modules of a tag, 1 for ink."""
    tags = cv2.aruco.getPredefinedDictionary(dictionary)
    n = tags.markerSize + 2
    return (cv2.aruco.generateImageMarker(tags, name, n) < 128).astype(float)


def roundel_reader() -> Callable[[Grey], Names]:
    """Reads a picture with a fresh detector."""

    def read(image: Grey) -> Names:
        found = Detector().detect(image)
        return [(int(n), uv) for n, uv in zip(found.id, found.uv, strict=True) if n > 0]

    return read


def opencv_reader(dictionary: int) -> Callable[[Grey], Names]:
    """OpenCV's detector with its defaults."""
    detector = cv2.aruco.ArucoDetector(cv2.aruco.getPredefinedDictionary(dictionary))

    def read(image: Grey) -> Names:
        corners, names, _ = detector.detectMarkers(image)
        if names is None:
            return []
        return [(int(n), c.reshape(4, 2).mean(axis=0)) for n, c in zip(names.ravel(), corners, strict=True)]

    return read


def apriltag_reader() -> Callable[[Grey], Names]:
    """AprilTag 3 without decimation, which loses small tags."""
    detector = importlib.import_module("pyapriltags").Detector(
        families="tag36h11", nthreads=1, quad_decimate=1.0
    )
    return lambda image: [(tag.tag_id, np.asarray(tag.center)) for tag in detector.detect(image)]


def kinds() -> dict[str, Kind]:
    """The kinds whose detectors are installed."""
    april, aruco = cv2.aruco.DICT_APRILTAG_36h11, cv2.aruco.DICT_4X4_100
    found = {
        "roundel": Kind(roundel, range(1, len(codes.words()) + 1), roundel_reader),
        "ArUco 4x4": Kind(partial(square, aruco), range(100), partial(opencv_reader, aruco)),
        "36h11, OpenCV": Kind(partial(square, april), range(587), partial(opencv_reader, april)),
    }
    if importlib.util.find_spec("pyapriltags"):
        found["36h11, AprilTag 3"] = Kind(partial(square, april), range(587), apriltag_reader)
    return found


def draw(kind: Kind, view: View, rng: np.random.Generator) -> tuple[Grey, list[tuple[int, Array]]]:
    """A picture of prints on clutter, with their names and places."""
    image = np.asarray(cv2.GaussianBlur(ground("clutter", rng), (0, 0), view.blur), float)
    shown = []
    for uv in grid(PRINTS, SIZE, rng):
        name, turn, spin = rng.choice(kind.names), rng.uniform(0, 2 * np.pi), rng.uniform(0, 2 * np.pi)
        card = Card(uv, view.side, float(np.radians(view.tilt)), float(turn))
        _paste(image, card, view.blur, partial(_turned, kind.shade, int(name), float(spin)))
        if view.cover:
            occlude(image, Card(uv, view.side), view.cover, float(rng.uniform(-1, 1)), rng)
        shown.append((int(name), np.array(uv)))
    return MILD.expose(image, rng), shown


def _turned(shade: Shade, name: int, spin: float, points: Array) -> Array:
    c, s = np.cos(spin), np.sin(spin)
    return shade(name, points @ np.array([[c, -s], [s, c]]))


def _paste(image: Array, card: Card, blur: float, shade: Callable[[Array], Array]) -> None:
    """Draw a print through a lens on an image that went through it."""
    margin = int(np.ceil(4 * blur)) + 1
    reach = int(card.diameter) + margin
    u0, v0 = (max(int(c) - reach, 0) for c in card.uv)
    u1, v1 = min(int(card.uv[0]) + reach, SIZE[1]), min(int(card.uv[1]) + reach, SIZE[0])
    sight = sight_of(card, (SIZE[1], SIZE[0]))
    lens = msgspec.structs.replace(
        sight.lens, width=u1 - u0, height=v1 - v0, cx=sight.lens.cx - u0, cy=sight.lens.cy - v0
    )
    there = replace(sight, lens=lens, uv=(card.uv[0] - u0, card.uv[1] - v0))
    points = plane_points(there, margin, PIECES)[:, 1:-1, 1:-1]
    seen = shade(points.reshape(2, -1).T).reshape(points.shape[1:])
    on_card = seen >= 0
    light, cover = (
        _through_lens(layer, blur, margin)
        for layer in (on_card * (PAPER - (PAPER - INK) * np.maximum(seen, 0)), on_card.astype(float))
    )
    part = image[v0:v1, u0:u1]
    part += light - cover * part


def _through_lens(fine: Array, blur: float, margin: int) -> Array:
    soft = np.asarray(cv2.GaussianBlur(fine, (0, 0), blur * PIECES), float)
    h, w = (n // PIECES for n in soft.shape)
    return soft.reshape(h, PIECES, w, PIECES).mean(axis=(1, 3))[margin : h - margin, margin : w - margin]


def rows(pictures: int) -> Iterator[tuple[str, ...]]:
    """For each view, the share in percent of each kind's prints that are read right, and the number read wrong."""
    readers = {name: (kind, kind.reader()) for name, kind in kinds().items()}
    for what, view in VIEWS.items():
        cells = []
        for kind, read in readers.values():
            right = wrong = 0
            for seed in range(pictures):
                image, shown = draw(kind, view, np.random.default_rng(seed))
                named = read(image)
                for name, uv in shown:
                    near = [n for n, place in named if np.linalg.norm(place - uv) < NEAR * view.side]
                    right, wrong = right + (name in near), wrong + any(n != name for n in near)
            cells.append(f"{100 * right / (pictures * PRINTS):.0f}" + f", {wrong} wrong" * bool(wrong))
        yield what, *cells
    cv2.setNumThreads(1)
    times = []
    for kind, read in readers.values():
        image, _ = draw(kind, View(40), np.random.default_rng(0))
        times.append(f"{milliseconds(partial(read, image), SECONDS):.1f}")
    yield "ms a picture", *times
