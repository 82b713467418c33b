# SPDX-License-Identifier: BSD-3-Clause
"""Renders the background of a simulated arena: a floor with tiles, tape, letters, dark discs and uneven light."""

import cv2
import numpy as np
from numpy.typing import NDArray

from camera_node.foundation.arrays import Array

Picture = NDArray[np.float32]
SIZE_M = 10.0  # side of the square floor around the world's origin
PIXEL_M = 0.005  # side of a pixel of the floor's image
FLOOR = 128.0
WALL = 120.0  # grey level outside the floor
SUBSAMPLES = 3  # each pixel has 3 x 3 sub-samples; the error at edges is then below 0.5 % of the contrast


def plain_floor() -> Picture:
    """A floor of one grey level, (n, n)."""
    n = round(SIZE_M / PIXEL_M)
    return np.full((n, n), FLOOR, np.float32)


def paint_floor(seed: int) -> Picture:
    """Grey levels of a cluttered floor, (n, n); columns run along the world's x axis, rows against its y axis.

    Its discs, letters and sheets of paper resemble roundels but are none.
    """
    rng = np.random.default_rng(seed)
    floor = plain_floor().astype(np.uint8)
    n = len(floor)
    floor[:: round(0.5 / PIXEL_M)] = floor[:, :: round(0.5 / PIXEL_M)] = 100
    for mark in (_paint_sheet, _paint_disc, _paint_letters, _paint_tape):
        for _ in range(14):
            mark(floor, rng, *rng.integers(n // 5, 4 * n // 5, 2).tolist())
    light = cv2.resize(
        rng.uniform(0.8, 1.15, (5, 5)).astype(np.float32), (n, n), interpolation=cv2.INTER_CUBIC
    )
    grain = rng.standard_normal((n, n), np.float32)
    return np.asarray(floor * light * (1 + np.float32(0.04) * grain), np.float32)


def view_floor(floor: Picture, rays: Picture, T_world_cam: Array, subsamples: int = SUBSAMPLES) -> Picture:
    """Render a camera's view (h, w) of the floor z = 0.

    Args:
        floor: grey levels from `paint_floor`.
        rays: (h, w, 2) x/z and y/z of each pixel's viewing ray.
        T_world_cam: (4, 4) pose of the camera.
        subsamples: squared, of each pixel.
    """
    h, w = rays.shape[:2]
    T = T_world_cam.astype(np.float32)
    fine = cv2.resize(rays, (w * subsamples, h * subsamples), interpolation=cv2.INTER_LINEAR)
    x, y, z = cv2.split(cv2.transform(fine, T[:3, :3]))  # cv2.transform extends (x, y) to (x, y, 1)
    reach = -T[2, 3] / np.minimum(z, np.float32(-1e-6))  # rays above the horizon end far away
    columns, rows = (_to_pixels(T[k, 3] + d * reach, sign) for k, d, sign in ((0, x, 1), (1, y, -1)))
    seen = cv2.remap(floor, columns, rows, cv2.INTER_LINEAR, borderValue=WALL)
    return np.asarray(cv2.resize(seen, (w, h), interpolation=cv2.INTER_AREA), np.float32)


def _to_pixels(at: Picture, sign: int) -> Picture:
    """Coordinates in the floor's image of places in the world, metres; `sign` is the axis' direction in it."""
    at *= np.float32(sign / PIXEL_M)
    at += np.float32(SIZE_M / 2 / PIXEL_M)
    return np.clip(at, -10, 32000, out=at)


def _paint_sheet(floor: NDArray[np.uint8], rng: np.random.Generator, u: int, v: int) -> None:
    corners = cv2.boxPoints(((u, v), (42, 60), float(rng.uniform(0, 180))))
    cv2.fillConvexPoly(floor, corners.astype(np.int32), int(rng.integers(190, 225)))
    cv2.circle(floor, (u, v), int(rng.integers(6, 12)), 45, -1, cv2.LINE_AA)


def _paint_disc(floor: NDArray[np.uint8], rng: np.random.Generator, u: int, v: int) -> None:
    cv2.circle(floor, (u, v), int(rng.integers(8, 26)), int(rng.integers(20, 70)), -1, cv2.LINE_AA)


def _paint_letters(floor: NDArray[np.uint8], rng: np.random.Generator, u: int, v: int) -> None:
    text = "".join(rng.choice(list("ABDGOQR0689"), 3))
    cv2.putText(floor, text, (u, v), cv2.FONT_HERSHEY_SIMPLEX, float(rng.uniform(1, 2)), 35, 5, cv2.LINE_AA)


def _paint_tape(floor: NDArray[np.uint8], rng: np.random.Generator, u: int, v: int) -> None:
    du, dv = rng.integers(-150, 150, 2).tolist()
    cv2.line(floor, (u, v), (u + du, v + dv), int(rng.choice([30, 210])), 10, cv2.LINE_AA)
