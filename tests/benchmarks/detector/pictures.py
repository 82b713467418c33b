# SPDX-License-Identifier: BSD-3-Clause
"""Renders images of cards: backgrounds, and ray-traced cards on them."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import cv2
import msgspec
import numpy as np

from camera_node.foundation.arrays import Array, Grey
from camera_node.geometry.lens import Lens
from tests.camera_node.tracing import Sight, ellipse_of, pixels_across, shape_of, trace_card

F = 600.0  # default focal length, pixels
NOISE = 3.0  # default noise, grey levels
PIECES = 4  # samples per pixel in either direction
SMALL = (120, 160)  # default size (h, w) of a picture of a few cards


def dead_leaves(size: tuple[int, int], rng: np.random.Generator) -> Array:
    """Clutter (h, w): shapes of all sizes that occlude each other, with statistics of photographs (Lee et al. 2001)."""
    h, w = size
    image = np.full(size, 110, np.uint8)
    sizes = 1 / np.sqrt(rng.uniform(1 / 160**2, 1 / 4**2, h * w // 150))  # a density of size^-3
    for reach in sizes:
        centre, level = rng.uniform((0, 0), (w, h)), float(rng.uniform(15, 240))
        box = (centre.tolist(), (reach * rng.uniform(0.4, 1), reach), float(rng.uniform(0, 180)))
        if rng.random() < 0.3:
            cv2.ellipse(image, box, level, -1, cv2.LINE_AA)
        else:
            cv2.fillConvexPoly(image, cv2.boxPoints(box).astype(np.int32), level, cv2.LINE_AA)
    return image.astype(float) + np.asarray(cv2.GaussianBlur(rng.normal(0, 12, size), (0, 0), 1.5), float)


def flat(size: tuple[int, int], level: float) -> Array:
    """One grey level (h, w)."""
    return np.full(size, level)


@dataclass(frozen=True)
class Card:
    """A card to render: its disc's centre and frontal diameter in pixels, its orientation, the print's ratio and code.

    `card`, `code` and `spin` are those of `Sight`.
    """

    uv: tuple[float, float]
    diameter: float
    tilt: float = 0.0
    turn: float = 0.0
    ratio: float = 0.6
    card: float = 9 / 7
    code: int = 0
    spin: float = 0.0


def paste(
    image: Array,
    cards: list[Card],
    blur: float = 0.7,
    *,
    dark: float = 40.0,
    bright: float = 190.0,
    focal: float = F,
) -> Array:
    """The image (h, w), blurred, with cards on it; each occludes the ground by its coverage of a pixel."""
    h, w = image.shape
    out = np.array(cv2.GaussianBlur(image, (0, 0), blur) if blur else image, float)
    for card in cards:
        sight = sight_of(card, (w, h), focal)
        box = _bound(sight, blur)
        light, cover = _layers(replace(sight, blur=blur, dark=dark, bright=bright), box)
        part = out[box[1] : box[3], box[0] : box[2]]
        part += light - cover * part
    return out


def render(
    cards: Sequence[Card],
    size: tuple[int, int] = SMALL,
    *,
    ground: float = 90.0,
    light: Array | None = None,
    **options: float,
) -> Array:
    """Cards on an even ground, (h, w); `options` are those of `paste`."""
    return paste(flat(size, float(ground)), list(cards), **options)


def outline_of(card: Card, size: tuple[int, int] = SMALL) -> tuple[Array, Array]:
    """Centre (2,) and full axes (2,) of the outer ellipse of a card in an image of size (h, w), pixels."""
    return ellipse_of(sight_of(card, (size[1], size[0])))


def sight_of(card: Card, size: tuple[int, int], focal: float = F) -> Sight:
    """A card in an image of size (w, h)."""
    w, h = size
    lens = Lens(width=w, height=h, fx=focal, fy=focal, cx=(w - 1) / 2, cy=(h - 1) / 2)
    distance = pixels_across(lens, 0.1, card.diameter)
    of_print = {name: getattr(card, name) for name in ("ratio", "card", "code", "spin")}
    return Sight(lens, card.uv, distance, tilt=card.tilt, turn=card.turn, ground=0.0, **of_print)


def rotation_of(card: Card, size: tuple[int, int]) -> float:
    """`Roundel.rotation_rad` by the true outline, where a code's zero is seen on it; in an image of size (h, w)."""
    sight = sight_of(card, (size[1], size[0]))
    n, c, r = sight.normal, sight.position, sight.diameter_m / 2
    first = np.array([1.0, 0.0, 0.0]) - n[0] * n
    first /= np.linalg.norm(first)
    zero = c + r * (np.cos(card.spin) * first + np.sin(card.spin) * np.cross(n, first))
    centre, S = shape_of(sight)
    values, axes = np.linalg.eigh(S)
    u, v = axes @ ((axes.T @ (sight.lens.project(zero[None])[0] - centre)) / np.sqrt(values))
    return float(np.arctan2(v, u))


def _bound(sight: Sight, blur: float) -> tuple[int, int, int, int]:
    """The part of the image that a card may touch, u0, v0, u1, v1. It is larger far from the optical axis."""
    (u, v), axes = ellipse_of(replace(sight, diameter_m=sight.card * sight.diameter_m))
    reach, (w, h) = axes.max() / 2 + 4 * blur + 3, (sight.lens.width, sight.lens.height)
    u0, v0 = max(int(u - reach), 0), max(int(v - reach), 0)
    return u0, v0, min(int(u + reach) + 1, w), min(int(v + reach) + 1, h)


@lru_cache(maxsize=256)  # the same cards are rendered on several backgrounds
def _layers(sight: Sight, box: tuple[int, int, int, int]) -> tuple[Array, Array]:
    """The light of a card in a box u0, v0, u1, v1 of the image, and its coverage of each pixel."""
    (u0, v0, u1, v1), lens, (u, v) = box, sight.lens, sight.uv
    moved = msgspec.structs.replace(lens, width=u1 - u0, height=v1 - v0, cx=lens.cx - u0, cy=lens.cy - v0)
    there = replace(sight, lens=moved, uv=(u - u0, v - v0))
    return trace_card(there, PIECES)


def grid(count: int, size: tuple[int, int], rng: np.random.Generator) -> list[tuple[float, float]]:
    """`count` positions on a grid that fills an image of size (h, w), each displaced by less than a pixel."""
    h, w = size
    columns = max(1, int(np.ceil(np.sqrt(count * w / h))))
    rows = int(np.ceil(count / columns))
    cells = [(k % columns, k // columns) for k in range(count)]
    moved = rng.uniform(-0.5, 0.5, (count, 2))
    return [
        (w * (i + 0.5) / columns + du, h * (j + 0.5) / rows + dv)
        for (i, j), (du, dv) in zip(cells, moved.tolist(), strict=True)
    ]


def expose(image: Array, noise: float, rng: np.random.Generator) -> Grey:
    """An 8-bit image with Gaussian noise."""
    noisy = image + np.float32(noise) * rng.standard_normal(image.shape, np.float32)
    return np.clip(np.rint(noisy), 0, 255).astype(np.uint8)


def missed(cards: list[Card], found: Array) -> int:
    """The number of cards without a detection (N, 2) within a fifth of the diameter from the centre."""
    if not (cards and len(found)):
        return len(cards)
    apart = np.linalg.norm(np.array([card.uv for card in cards])[:, None] - found, axis=2).min(axis=1)
    return int((apart > [0.2 * card.diameter for card in cards]).sum())
