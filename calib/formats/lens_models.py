# SPDX-License-Identifier: BSD-3-Clause
"""Expresses a lens with fewer distortion coefficients, for formats that have no place for all of them."""

import numpy as np

from calib.errors import CalibrationError
from camera_node.foundation.arrays import Array
from camera_node.geometry.lens import Lens

GRID = 25  # points across and down the image
STEPS = 10
MAX_OFF_PX = 1.0  # a lens that differs more is another lens


def with_coefficients(name: str, lens: Lens, count: int) -> tuple[Lens, float]:
    """The lens with `count` distortion coefficients that is nearest to a lens over its image.

    Focal length, centre and coefficients are adjusted by Gauss-Newton to the viewing rays of a grid of pixels.

    Returns:
        the lens, and the largest distance between both lenses' pixels of one ray.

    Raises:
        CalibrationError: they differ by more than 1 px.
    """
    coefficients = (*lens.distortion, *[0.0] * count)
    shorter = lens.with_parameters([*lens.parameters[:4], *coefficients[:count]])
    if not any(coefficients[count:]):
        return shorter, 0.0
    u, v = np.meshgrid(np.linspace(0, lens.width - 1, GRID), np.linspace(0, lens.height - 1, GRID))
    pixels = np.column_stack([u.ravel(), v.ravel()])
    rays = lens.rays(pixels)
    known = np.isfinite(rays).all(axis=1)
    for _ in range(STEPS):
        uv, _, J = shorter.project_with_jacobians(rays[known])
        step = np.linalg.lstsq(J.reshape(-1, J.shape[2]), (pixels[known] - uv).ravel())[0]
        shorter = shorter.with_parameters(shorter.parameters + step)
    off = _largest(pixels[known] - shorter.project(rays[known]))
    if not off <= MAX_OFF_PX:
        raise CalibrationError(
            f"camera '{name}': its lens can't be written with {count} distortion coefficients, as this format has; "
            f"it would be off by {off:.1f} px"
        )
    return shorter, off


def _largest(offsets: Array) -> float:
    return float(np.linalg.norm(offsets, axis=1).max())
