# SPDX-License-Identifier: BSD-3-Clause
"""Renders images of roundels for tests: 8 x 8 samples per pixel are looked up on the printed sheet, then blurred.

The renderer is independent of the detector's model of an edge."""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from camera_node.foundation.arrays import Array

FINE = 8


@dataclass(frozen=True)
class Disc:
    """A printed roundel in front of a pinhole camera of focal length `f`.

    Attributes:
        uv: pixel of the image of the disc's centre.
        diameter: of the frontal disc, pixels.
        tilt: angle between the normal and the optical axis, radians; `turn` is its direction in the image.
        ratio: inner over outer diameter; `card` is that of the card over the outer one.
    """

    uv: tuple[float, float]
    diameter: float
    tilt: float = 0.0
    turn: float = 0.0
    ratio: float = 0.6
    card: float = 9 / 7
    f: float = 600.0

    @property
    def normal(self) -> Array:
        s = np.sin(self.tilt)
        return np.array([s * np.cos(self.turn), s * np.sin(self.turn), -np.cos(self.tilt)])


def _radius_squared(disc: Disc, u: Array, v: Array, principal: Array) -> Array:
    """Squared distance from the disc's centre, in outer radii, of the points of its plane at pixels (u, v)."""
    rays = np.stack([u - principal[0], v - principal[1], np.full(u.shape, disc.f)], axis=-1) / disc.f
    centre = np.array([*(np.array(disc.uv) - principal) / disc.f, 1.0])  # at a depth of 1
    depth = (centre @ disc.normal) / (rays @ disc.normal)
    offset = depth[..., None] * rays - centre
    return (offset**2).sum(axis=-1) / (disc.diameter / disc.f / 2) ** 2


def outer_conic(disc: Disc, principal: Array) -> tuple[Array, Array]:
    """Centre (2,) and full axes (2,) of the outer ellipse in pixels, from the dual conic c c^T - r^2 (I - n n^T)."""
    c = np.array([*(np.array(disc.uv) - principal) / disc.f, 1.0])
    r = disc.diameter / disc.f / 2
    dual = np.outer(c, c) - r * r * (np.eye(3) - np.outer(disc.normal, disc.normal))
    K = np.array([[disc.f, 0, principal[0]], [0, disc.f, principal[1]], [0, 0, 1.0]])
    dual = K @ dual @ K.T
    dual /= dual[2, 2]
    centre = dual[:2, 2]
    shape = np.outer(centre, centre) - dual[:2, :2]
    return centre, 2 * np.sqrt(np.linalg.eigvalsh(shape)[::-1])


def render(
    discs: list[Disc],
    size: tuple[int, int] = (120, 160),
    *,
    dark: float = 40.0,
    bright: float = 190.0,
    ground: float = 90.0,
    blur: float = 0.7,
    light: Array | None = None,
) -> Array:
    """Grey levels (h, w), float, without noise. `light` (h, w) multiplies them."""
    h, w = size
    principal = np.array([(w - 1) / 2, (h - 1) / 2])
    step = (np.arange(max(h, w) * FINE) + 0.5) / FINE - 0.5
    u, v = np.meshgrid(step[: w * FINE], step[: h * FINE])
    fine = np.full(u.shape, float(ground))
    for disc in discs:
        reach = disc.diameter
        x0, y0 = (max(0, int((c - reach) * FINE)) for c in disc.uv)
        x1, y1 = (max(0, int((c + reach) * FINE)) for c in disc.uv)
        box = np.s_[y0:y1, x0:x1]
        rr = _radius_squared(disc, u[box], v[box], principal)
        part = fine[box]
        part[rr < disc.card**2] = bright
        part[rr < 1] = dark
        part[rr < disc.ratio**2] = bright
    if blur:
        fine = cv2.GaussianBlur(fine, (0, 0), blur * FINE)
    image = fine.reshape(h, FINE, w, FINE).mean(axis=(1, 3))
    return image if light is None else image * light


def expose(image: ArrayLike, noise: float, rng: np.random.Generator) -> NDArray[np.uint8]:
    """An 8-bit image with Gaussian noise."""
    grey = np.asarray(image, float)
    return np.clip(np.rint(grey + rng.normal(0, noise, grey.shape)), 0, 255).astype(np.uint8)
