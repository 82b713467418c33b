# SPDX-License-Identifier: BSD-3-Clause
"""Draws a precision map: the grid as coloured cells, and the cameras around it."""

from collections.abc import Mapping, Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from calib.rig.camera import Camera
from calib.rig.precision_map import PrecisionMap, format_mm
from camera_node.foundation.arrays import Array

CELL = 46  # pixels of one grid cell
MARGIN = 3 * CELL
INK, PAPER = (40, 35, 30), (252, 252, 250)
HIDDEN = (225, 225, 225)  # cells that fewer than two cameras see


def draw_precision(precision: PrecisionMap, cameras: Mapping[str, Camera]) -> NDArray[np.uint8]:
    """Draw the map as an image (h, w, 3) BGR, with placed cameras by name."""
    rows, columns = precision.sigma_mm.shape
    canvas = np.full((rows * CELL + 2 * MARGIN, columns * CELL + 2 * MARGIN, 3), PAPER, np.uint8)
    _draw_cells(canvas, precision)
    _draw_cameras(canvas, precision, cameras)
    _draw_axes(canvas, precision)
    title = f"expected error, mm, at z = {precision.grid.z:.2f} m: {precision.typical_mm:.2f} in the median"
    _draw_text(canvas, title, (8, 18))
    return canvas


def _draw_cells(canvas: np.ndarray, precision: PrecisionMap) -> None:
    sigma_mm = precision.sigma_mm
    best = max(float(np.min(sigma_mm)), 1e-6) if np.isfinite(sigma_mm).any() else 1.0
    for (row, column), value in np.ndenumerate(sigma_mm):
        u, v = MARGIN + column * CELL, MARGIN + (len(sigma_mm) - 1 - row) * CELL
        share = min(np.log2(max(value / best, 1.0)) / 4, 1.0) if np.isfinite(value) else 1.0
        colour = (60 + 60 * share, 200 - 130 * share, 90 + 150 * share) if np.isfinite(value) else HIDDEN
        cv2.rectangle(canvas, (u, v), (u + CELL - 2, v + CELL - 2), colour, -1)
        if np.isfinite(value):
            _draw_text(canvas, format_mm(value), (u + 5, v + CELL / 2 + 4))


def _draw_cameras(canvas: np.ndarray, precision: PrecisionMap, cameras: Mapping[str, Camera]) -> None:
    grid = precision.grid
    step = grid.x[1] - grid.x[0] if len(grid.x) > 1 else 1.0
    for name, camera in cameras.items():
        position: Array = camera.matrix()[:2, 3]
        u = MARGIN + ((position[0] - grid.x[0]) / step + 0.5) * CELL
        v = MARGIN + (len(grid.y) - 0.5 - (position[1] - grid.y[0]) / step) * CELL
        u, v = np.clip(u, 8, canvas.shape[1] - 8), np.clip(v, 36, canvas.shape[0] - 8)
        cv2.circle(canvas, (round(u), round(v)), 6, (200, 90, 20), -1, cv2.LINE_AA)
        fits_right = canvas.shape[1] - u > 9 * len(name) + 12
        _draw_text(canvas, name, (u + 9 if fits_right else u - 9 * len(name) - 6, v + 4))


def _draw_axes(canvas: np.ndarray, precision: PrecisionMap) -> None:
    grid, bottom = precision.grid, canvas.shape[0] - MARGIN
    for column, x in enumerate(grid.x):
        _draw_text(canvas, f"{x:.2f}", (MARGIN + column * CELL + 5, bottom + 16))
    for row, y in enumerate(grid.y):
        _draw_text(canvas, f"{y:>5.2f}", (MARGIN - 42, bottom - (row + 0.5) * CELL + 4))
    _draw_text(canvas, "y / x, m", (MARGIN - 42, bottom + 34))


def _draw_text(canvas: np.ndarray, text: str, at: Sequence[float]) -> None:
    place = (round(float(at[0])), round(float(at[1])))
    cv2.putText(canvas, text, place, cv2.FONT_HERSHEY_SIMPLEX, 0.42, INK, 1, cv2.LINE_AA)
