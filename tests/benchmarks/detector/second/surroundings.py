# SPDX-License-Identifier: BSD-3-Clause
"""Grounds by procedural noise, and light: fractal illumination, penumbrae of a round lamp, highlights, slopes."""

from collections.abc import Callable

import cv2
import numpy as np

from camera_node.foundation.arrays import Array
from tests.benchmarks.detector.second.print_geometry import Print

EVEN = 0.42  # albedo of the even ground
Ground = Callable[[tuple[int, int], np.random.Generator], Array]


def noise(size: tuple[int, int], cell: tuple[float, float], rng: np.random.Generator) -> Array:
    """Smooth noise (h, w) of mean 0 and variance of about 0.5: random values on cells (h, w), interpolated."""
    h, w = size
    few = rng.standard_normal((int(h / cell[0]) + 3, int(w / cell[1]) + 3))
    wide = (max(w, int(few.shape[1] * cell[1])), max(h, int(few.shape[0] * cell[0])))
    return np.asarray(cv2.resize(few, wide, interpolation=cv2.INTER_CUBIC), float)[:h, :w]


def fractal(size: tuple[int, int], cell: float, octaves: int, rng: np.random.Generator) -> Array:
    """Noise (h, w) whose octaves have half of the cell and half of the amplitude each."""
    return np.sum([noise(size, (cell / 2**k,) * 2, rng) / 2**k for k in range(octaves)], axis=0)


def even(size: tuple[int, int], rng: np.random.Generator) -> Array:
    """One albedo."""
    return np.full(size, EVEN)


def wood(size: tuple[int, int], rng: np.random.Generator) -> Array:
    """Planks with growth rings that are stretched along the grain, fibres, and gaps."""
    y, x = np.mgrid[: size[0], : size[1]].astype(float)
    width = rng.uniform(100, 260)
    plank = np.floor(y / width).astype(int)
    shift, shade = (
        rng.uniform(0, 400, plank.max() + 1)[plank],
        rng.uniform(0.25, 0.55, plank.max() + 1)[plank],
    )
    warp = 60 * noise(size, (width, 700), rng) + 8 * noise(size, (40, 300), rng)
    rings = 0.5 + 0.5 * np.sin((y + shift + warp + 0.02 * x) / rng.uniform(3, 8))
    fibres = noise(size, (2.5, 90), rng)
    gaps = np.clip(np.abs((y + width / 2) % width - width / 2) / 3, 0.25, 1)
    return np.clip(shade * (0.75 + 0.35 * rings**2 + 0.08 * fibres) * gaps, 0.02, 0.9)


def carpet(size: tuple[int, int], rng: np.random.Generator) -> Array:
    """Tufts of a few pixels in two colours, with larger spots."""
    tuft = rng.uniform(4, 10)
    pile = noise(size, (tuft, tuft), rng) + 0.6 * noise(size, (tuft / 2, tuft / 2), rng)
    pattern = np.tanh(2 * fractal(size, 160, 3, rng))
    return np.clip(rng.uniform(0.15, 0.5) * (1 + 0.35 * pile + 0.2 * pattern), 0.02, 0.9)


def tiles(size: tuple[int, int], rng: np.random.Generator) -> Array:
    """Marbled tiles with dark joints, rotated."""
    y, x = np.mgrid[: size[0], : size[1]].astype(float)
    turn, side = rng.uniform(0, np.pi), rng.uniform(90, 260)
    u, v = np.cos(turn) * x + np.sin(turn) * y, np.cos(turn) * y - np.sin(turn) * x
    i, j = np.floor(u / side).astype(int), np.floor(v / side).astype(int)
    shades = rng.uniform(0.35, 0.75, (64, 64))[i % 64, j % 64]
    veins = np.abs(fractal(size, 120, 4, rng))
    joint = np.minimum(np.abs((u + side / 2) % side - side / 2), np.abs((v + side / 2) % side - side / 2))
    return np.where(joint < 4, 0.15, np.clip(shades * (0.8 + 0.3 * np.minimum(veins, 1)), 0.02, 0.9))


TEXTURES: tuple[Ground, ...] = (wood, carpet, tiles)


def penumbra(plane: Array, rng: np.random.Generator) -> Array:
    """Light (N,) at points of a print's plane behind a round obstacle that takes half of it from a round lamp.

    The visible share of a disc behind a straight edge is 1/2 + (x sqrt(1 - x^2) + asin x) / pi.
    """
    turn, reach = rng.uniform(0, 2 * np.pi), rng.uniform(2, 8)
    middle = (reach + rng.uniform(-1, 1)) * np.array([np.cos(turn), np.sin(turn)])
    x = np.clip((np.linalg.norm(plane - middle, axis=1) - reach) / rng.uniform(0.2, 0.8), -1, 1)
    return 0.5 + 0.5 * (0.5 + (x * np.sqrt(1 - x * x) + np.arcsin(x)) / np.pi)


def highlight(card: Print, plane: Array, rng: np.random.Generator) -> Array:
    """The specular lobe (N,) of a lamp (Blinn 1977), 1 at its peak, which lies within the disc.

    The lamp is two to six times as far as the camera.
    """
    e, at = card.axes, rng.uniform(-0.7, 0.7, 2)
    points = card.centre + plane @ e[:, :2].T
    peak = card.centre + e[:, :2] @ at
    towards = -peak / np.linalg.norm(peak)
    mirrored = 2 * (towards @ e[:, 2]) * e[:, 2] - towards
    lamp = peak + mirrored * np.linalg.norm(peak) * rng.uniform(2, 6)
    half = _unit(lamp - points) + _unit(-points)
    # An exponent for a lobe with a standard deviation of 0.4 to 1 outer radii across the line of sight.
    width = float(rng.uniform(0.4, 1.0) / np.linalg.norm(peak)) / 1.6
    return np.asarray(np.maximum(_unit(half) @ e[:, 2], 0) ** (1 / width**2), float)


def facing(card: Print, plane: Array, rng: np.random.Generator) -> Array:
    """Lambert's cosine (N,) of curled paper over that of flat paper, under a lamp 40 degrees from the normal."""
    return 1 + np.tan(np.radians(40)) * np.cos(rng.uniform(0, 2 * np.pi)) * card.slope_of(plane)


def _unit(vectors: Array) -> Array:
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)
