# SPDX-License-Identifier: BSD-3-Clause
"""Residuals of a lens all over its image: what a model that does not fit looks like."""

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from camera_node.arrays import Array, Mask
from camera_node.errors import ConfigError
from camera_node.geometry.lens import Lens

WIDTH = 1200  # pixels of the picture
TITLE = 34  # pixels above it
TYPICAL = 18  # pixels that the 90 % quantile of the arrows is long
CELLS = (6, 8)
SHIFT = 4  # OpenCV draws in 1/16 pixels
PAPER, INK, FIELD, SHADE = (252, 252, 250), (60, 50, 40), (200, 90, 20), (205, 225, 250)


def draw_residuals(
    name: str, lens: Lens, seen: Array, residuals: Array, missing: Mask | None = None
) -> NDArray[np.uint8]:
    """An arrow from every point's expected place, magnified, coloured by its length; the cells' mean over them.

    Noise points anywhere; a lens model that does not fit shows as a pattern of the thick arrows.

    Args:
        name, lens: the camera.
        seen, residuals: (n, 2) each, pixels: where points were seen, and that less where they were expected.
        missing: (rows, columns) cells of the image to be shaded: where to go next.

    Returns:
        (h, 1200, 3) BGR.
    """
    scale = WIDTH / lens.width
    lengths = np.linalg.norm(residuals, axis=1)
    typical = max(float(np.quantile(lengths, 0.9)), 1e-6) if len(lengths) else 1.0
    gain = TYPICAL / typical
    canvas = np.full((TITLE + round(lens.height * scale), WIDTH, 3), PAPER, np.uint8)
    if missing is not None:
        _shade(canvas, missing)
    starts = (seen - residuals + 0.5) * scale + [0, TITLE]
    for start, r, length in zip(starts, residuals, lengths, strict=True):
        _arrow(canvas, start, gain * r, _colour(length / (2 * typical)), 1)
    for start, r in _cell_means(starts, residuals, canvas.shape[0]):
        _arrow(canvas, start, gain * r, FIELD, 3)
    rms = float(np.sqrt((lengths**2).mean())) if len(lengths) else float("nan")
    title = f"{name}: RMS {rms:.3f} px, {len(seen)} points, arrows x {gain:.0f}; thick: mean of a cell"
    title += "; shaded: not waved through" if missing is not None else ""
    cv2.putText(canvas, title, (8, TITLE - 12), cv2.FONT_HERSHEY_SIMPLEX, 0.5, INK, 1, cv2.LINE_AA)
    return canvas


def save_map(path: Path, picture: NDArray[np.uint8]) -> None:
    """Write a picture as PNG.

    Raises:
        ConfigError: the folder can't be made or written to.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(cv2.imencode(".png", picture)[1].tobytes())
    except OSError as error:
        raise ConfigError(f"{path} can't be written: {error.strerror}") from None


def _shade(canvas: np.ndarray, cells: Mask) -> None:
    rows = np.linspace(TITLE, canvas.shape[0], cells.shape[0] + 1).round().astype(int)
    columns = np.linspace(0, WIDTH, cells.shape[1] + 1).round().astype(int)
    for r, c in np.argwhere(cells):
        canvas[rows[r] : rows[r + 1], columns[c] : columns[c + 1]] = SHADE


def _cell_means(starts: Array, residuals: Array, height: int) -> list[tuple[Array, Array]]:
    """Middle and mean residual of the cells with four corners or more."""
    size = np.array([WIDTH / CELLS[1], (height - TITLE) / CELLS[0]])
    cells = ((starts - [0, TITLE]) // size).astype(int)
    out = []
    for cell in np.unique(cells, axis=0):
        mine = (cells == cell).all(axis=1)
        if mine.sum() >= 4:
            out.append(((cell + 0.5) * size + [0, TITLE], residuals[mine].mean(axis=0)))
    return out


def _colour(share: float) -> tuple[int, int, int]:
    """Green to red, BGR."""
    x = min(max(share, 0.0), 1.0)
    return (40, round(170 * (1 - x)), round(60 + 180 * x))


def _arrow(canvas: np.ndarray, start: Array, by: Array, colour: tuple[int, int, int], thickness: int) -> None:
    a, b = (tuple(int(x) for x in np.rint(p * 2**SHIFT)) for p in (start, start + by))
    cv2.line(canvas, a, b, colour, thickness, cv2.LINE_AA, SHIFT)
    cv2.circle(canvas, a, (1 + thickness) << (SHIFT - 1), colour, -1, cv2.LINE_AA, SHIFT)
