# SPDX-License-Identifier: BSD-3-Clause
"""Composes pictures of prints: coverage, ground and light on a fine raster, then the lens of that part of the picture.

A picture consists of 5 x 4 parts. Each has one print and a point spread of its own.
"""

from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np

from camera_node.foundation.arrays import Array
from tests.benchmarks.detector.second.optics import REACH, Lens, blur, centroid_of
from tests.benchmarks.detector.second.print_geometry import CARD, INNER, SIZE, Print, coverage, screen
from tests.benchmarks.detector.second.surroundings import (
    EVEN,
    Ground,
    even,
    facing,
    fractal,
    highlight,
    penumbra,
)

PIECES = 4  # samples per pixel in either direction
FINEST = 3  # samples of a half-tone per sample, in either direction
COLUMNS, ROWS = 5, 4
PART = (SIZE[0] // ROWS, SIZE[1] // COLUMNS)
WIDE = (SIZE[0] + 2 * REACH, SIZE[1] + 2 * REACH)  # what the margins of all parts cover
COARSE = 2  # samples per pixel of the ground
MAX_TILT = np.pi / 3
Light = Literal["room", "shadow", "gloss"]


@dataclass(frozen=True)
class Levels:
    """Linear levels of 255 under full light: paper, ink, and a ground of albedo 1."""

    paper: float
    ink: float
    ground: float

    @classmethod
    def draw(cls, rng: np.random.Generator) -> "Levels":
        """Paper of albedo 0.88 and ink of 0.05 to 0.18, exposed so that the paper is at 150 to 205."""
        white = rng.uniform(150, 205) / 0.88
        return cls(0.88 * white, rng.uniform(0.05, 0.18) * white, white)


@dataclass(frozen=True)
class Scene:
    """What all parts of a picture share: levels, lens, albedo of the ground and illumination at `COARSE` samples."""

    levels: Levels
    lens: Lens
    albedo: Array
    illumination: Array

    @classmethod
    def draw(cls, ground: Ground, coma: float, rng: np.random.Generator) -> "Scene":
        """A scene on a ground, by a lens with this coma; light varies by some 5 % over a hundred pixels and more."""
        fine = (COARSE * WIDE[0], COARSE * WIDE[1])
        light = cv2.resize(1 + 0.06 * fractal(WIDE, 320, 3, rng), fine[::-1])
        return cls(
            Levels.draw(rng),
            Lens(float(rng.uniform(0.3, 0.9)), coma=coma),
            ground(fine, rng),
            np.asarray(light, float),
        )


def draw_prints(
    band: tuple[int, int], rng: np.random.Generator, *, square: bool = False, curl: float = 0.0
) -> list[Print]:
    """One print in each part, of a diameter within the band, tilted by up to 60 degrees."""
    return [
        Print(
            (x - 0.5 + PART[1] * (i + 0.5), y - 0.5 + PART[0] * (j + 0.5)),
            float(rng.uniform(*band)),
            float(rng.uniform(0, MAX_TILT)),
            float(rng.uniform(0, 2 * np.pi)),
            square,
            float(curl * rng.choice([-1, 1])),
            float(rng.uniform(0, 2 * np.pi)),
        )
        for j in range(ROWS)
        for i in range(COLUMNS)
        for x, y in rng.uniform(-3, 3, (1, 2))
    ]


def render(scene: Scene, prints: list[Print], light: Light, rng: np.random.Generator) -> Array:
    """Light (h, w) on the sensor, linear levels of 255; without prints, the ground alone."""
    out = np.empty(SIZE)
    for k in range(ROWS * COLUMNS):
        j, i = divmod(k, COLUMNS)
        v, u = j * PART[0], i * PART[1]
        part = render_part(scene, (v, u), prints[k] if prints else None, light, rng)
        out[v : v + PART[0], u : u + PART[1]] = part[REACH:-REACH, REACH:-REACH]
    return out


def render_part(
    scene: Scene, corner: tuple[int, int], card: Print | None, light: Light, rng: np.random.Generator
) -> Array:
    """The light of a part with its margin of `REACH` pixels; `corner` is its upper left pixel, v and u."""
    h, w = ((n + 2 * REACH) * PIECES for n in PART)
    lit, albedo = (_part(layer, corner, (h, w)) for layer in (scene.illumination, scene.albedo))
    fine = albedo * scene.levels.ground * lit
    if card is not None:
        fine = _show(fine, lit, scene.levels, card, corner, light, rng)
    sharp = blur(fine, spread_of(scene.lens, corner))
    return sharp.reshape(h // PIECES, PIECES, w // PIECES, PIECES).mean(axis=(1, 3))


def spread_of(lens: Lens, corner: tuple[int, int]) -> Array:
    """The point spread in the middle of a part."""
    middle = np.array([corner[1] + PART[1] / 2, corner[0] + PART[0] / 2])
    half = np.array([SIZE[1], SIZE[0]]) / 2
    return lens.spread((middle - half) / float(np.hypot(*half)), PIECES)


def _part(layer: Array, corner: tuple[int, int], shape: tuple[int, int]) -> Array:
    rows, columns = ((n // PIECES) * COARSE for n in shape)
    v, u = (COARSE * c for c in corner)
    scale = (PIECES // COARSE,) * 2
    return np.asarray(np.kron(layer[v : v + rows, u : u + columns], np.ones(scale)), float)


def _show(
    ground: Array,
    lit: Array,
    levels: Levels,
    card: Print,
    corner: tuple[int, int],
    light: Light,
    rng: np.random.Generator,
) -> Array:
    """The fine raster (h, w) with a print and the light on it."""
    h, w = ground.shape
    origin = np.array([corner[1] - REACH - 0.5, corner[0] - REACH - 0.5])
    whole, black, hole, *ticks = (
        coverage((line - origin) * PIECES, (h, w)) for line in (*card.outlines, *card.ticks)
    )
    ink = black - hole + sum(ticks)
    if card.screened:
        inked = np.nonzero(ink)
        ink[inked] *= 1 - _bare(card, np.stack(inked[::-1], axis=1).astype(float), origin)
    paper = (levels.paper * (whole - ink) + levels.ink * ink) * lit
    if light == "room" and not card.curl:
        return ground * (1 - whole) + paper
    plane = _plane(card, (h, w), origin)
    if card.curl:
        paper = paper * facing(card, plane, rng).reshape(h, w)
    out = ground * (1 - whole) + paper
    if light == "shadow":
        out = out * penumbra(plane, rng).reshape(h, w)
    if light == "gloss":
        out = out + rng.uniform(40, 80) * whole * highlight(card, plane, rng).reshape(h, w)
    return out


def _bare(card: Print, samples: Array, origin: Array) -> Array:
    """The share (N,) of samples (N, 2), columns and rows of the raster, that a half-tone leaves without ink."""
    part = (np.arange(FINEST) + 0.5) / FINEST
    at = samples[:, None] + np.stack(np.meshgrid(part, part), axis=-1).reshape(-1, 2)
    return (
        screen(_unproject(card, at.reshape(-1, 2) / PIECES + origin)).reshape(len(samples), -1).mean(axis=1)
    )


def _plane(card: Print, shape: tuple[int, int], origin: Array) -> Array:
    """Where the samples (h, w) of a part see the plane of the flat print, (h w, 2)."""
    y, x = np.mgrid[: shape[0], : shape[1]]
    return _unproject(card, (np.stack([x.ravel(), y.ravel()], axis=1) + 0.5) / PIECES + origin)


def _unproject(card: Print, pixels: Array) -> Array:
    """Where pixels (N, 2) see the plane of the flat print, (N, 2)."""
    seen = np.column_stack([pixels, np.ones(len(pixels))]) @ np.linalg.inv(card.homography).T
    return seen[:, :2] / seen[:, 2:]


def moment_errors(count: int) -> tuple[float, float]:
    """The generator against closed forms: largest errors of light's centroid, pixels, and of its amount, relative.

    Prints on an even ground without noise. The image of a disc has the area and centroid of the ellipse that the
    conic gives; a lens moves the centroid by that of its point spread.
    """
    rng, worst, levels = np.random.default_rng(5), np.zeros(2), Levels(190.0, 40.0, 90.0 / EVEN)
    even_light = np.ones((COARSE * WIDE[0], COARSE * WIDE[1]))
    for _ in range(count):
        scene = Scene(
            levels, Lens(float(rng.uniform(0.3, 0.9)), coma=0.4), even(even_light.shape, rng), even_light
        )
        prints = draw_prints((14, 60), rng)
        k = int(rng.integers(len(prints)))
        corner = (k // COLUMNS * PART[0], k % COLUMNS * PART[1])
        part = render_part(scene, corner, prints[k], "room", rng) - EVEN * levels.ground
        v, u = np.mgrid[: part.shape[0], : part.shape[1]]
        seen = np.array([(part * u).sum(), (part * v).sum()]) / part.sum()
        seen += [corner[1] - REACH, corner[0] - REACH] - centroid_of(spread_of(scene.lens, corner), PIECES)
        due, centroid = _due(prints[k], levels, EVEN * levels.ground)
        worst = np.maximum(worst, [np.hypot(*(seen - centroid)), abs(part.sum() / due - 1)])
    return float(worst[0]), float(worst[1])


def _due(card: Print, levels: Levels, ground: float) -> tuple[float, Array]:
    """The amount of light that a print adds to an even ground, and its centroid (2,)."""
    steps = levels.paper - ground, levels.ink - levels.paper, levels.paper - levels.ink
    amount, first = 0.0, np.zeros(2)
    for step, radius in zip(steps, (CARD, 1.0, INNER), strict=True):
        centre, axes = card.ellipse(radius)
        amount += step * np.pi / 4 * axes.prod()
        first += step * np.pi / 4 * axes.prod() * centre
    return amount, first / amount
