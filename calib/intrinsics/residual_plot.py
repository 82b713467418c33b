# SPDX-License-Identifier: BSD-3-Clause
"""Draws the residuals of a lens across its image, which show a lens model that does not fit."""

import cv2
import numpy as np
from numpy.typing import NDArray

from calib.rig.coverage import CELLS
from calib.rig.estimation import rms
from calib.rig.precision_map import PAPER
from camera_node.detection.overlay import SHIFT
from camera_node.foundation.arrays import Array, Mask
from camera_node.geometry.lens import Lens

WIDTH = 1200  # pixels of the plot
TITLE = 34  # pixels above it
ARROW = 18  # pixels, the length of the 90 % quantile of the residuals
MIN_POINTS = 4  # in a cell with a mean residual
INK, MEAN, SHADE = (60, 50, 40), (200, 90, 20), (205, 225, 250)


def draw_residuals(
    name: str, lens: Lens, observed: Array, residuals: Array, missing: Mask | None = None
) -> NDArray[np.uint8]:
    """Draw residuals as magnified arrows, coloured by length, and the mean of each cell as a thick arrow.

    Noise points in all directions; a lens model that does not fit shows as a pattern of thick arrows.

    Args:
        name, lens: the camera.
        observed: (n, 2) observed points, pixels.
        residuals: (n, 2) observed less predicted points, pixels.
        missing: (rows, columns) cells of the image to shade: where to wave next.

    Returns:
        (h, 1200, 3) BGR.
    """
    scale = WIDTH / lens.width
    lengths = np.linalg.norm(residuals, axis=1)
    typical = max(float(np.quantile(lengths, 0.9)), 1e-6) if len(lengths) else 1.0
    gain = ARROW / typical
    canvas = np.full((TITLE + round(lens.height * scale), WIDTH, 3), PAPER, np.uint8)
    if missing is not None:
        _shade_cells(canvas, missing)
    starts = (observed - residuals + 0.5) * scale + [0, TITLE]
    for start, r, length in zip(starts, residuals, lengths, strict=True):
        _draw_arrow(canvas, start, gain * r, _green_to_red(length / (2 * typical)), 1)
    for start, r in _cell_means(starts, residuals, canvas.shape[0]):
        _draw_arrow(canvas, start, gain * r, MEAN, 3)
    title = f"{name}: RMS {rms(lengths):.3f} px, {len(observed)} points, arrows x {gain:.0f}; thick: mean of a cell"
    title += "; shaded: wand not seen" if missing is not None else ""
    cv2.putText(canvas, title, (8, TITLE - 12), cv2.FONT_HERSHEY_SIMPLEX, 0.5, INK, 1, cv2.LINE_AA)
    return canvas


def _shade_cells(canvas: np.ndarray, cells: Mask) -> None:
    rows = np.linspace(TITLE, canvas.shape[0], cells.shape[0] + 1).round().astype(int)
    columns = np.linspace(0, WIDTH, cells.shape[1] + 1).round().astype(int)
    for r, c in np.argwhere(cells):
        canvas[rows[r] : rows[r + 1], columns[c] : columns[c + 1]] = SHADE


def _cell_means(starts: Array, residuals: Array, height: int) -> list[tuple[Array, Array]]:
    """Centre and mean residual of each cell with enough points."""
    size = np.array([WIDTH / CELLS[1], (height - TITLE) / CELLS[0]])
    cells = ((starts - [0, TITLE]) // size).astype(int)
    means = []
    for cell in np.unique(cells, axis=0):
        rows = (cells == cell).all(axis=1)
        if rows.sum() >= MIN_POINTS:
            means.append(((cell + 0.5) * size + [0, TITLE], residuals[rows].mean(axis=0)))
    return means


def _green_to_red(share: float) -> tuple[int, int, int]:
    """A colour, BGR: green at 0, red at 1."""
    x = min(max(share, 0.0), 1.0)
    return (40, round(170 * (1 - x)), round(60 + 180 * x))


def _draw_arrow(
    canvas: np.ndarray, start: Array, by: Array, colour: tuple[int, int, int], thickness: int
) -> None:
    a, b = (tuple(int(x) for x in np.rint(p * 2**SHIFT)) for p in (start, start + by))
    cv2.line(canvas, a, b, colour, thickness, cv2.LINE_AA, SHIFT)
    cv2.circle(canvas, a, (1 + thickness) << (SHIFT - 1), colour, -1, cv2.LINE_AA, SHIFT)
