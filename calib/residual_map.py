# SPDX-License-Identifier: BSD-3-Clause
"""Residuals of a lens all over its image: what a model that does not fit looks like."""

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from calib.lens_adjustment import AdjustedLens, BoardView
from camera_node.errors import ConfigError

Array = NDArray[np.float64]

WIDTH = 1200  # pixels of the picture
TITLE = 34  # pixels above it
TYPICAL = 18  # pixels that the 90 % quantile of the arrows is long
CELLS = (6, 8)
SHIFT = 4  # OpenCV draws in 1/16 pixels
PAPER, INK, FIELD = (252, 252, 250), (60, 50, 40), (200, 90, 20)


def draw_residuals(name: str, views: Sequence[BoardView], adjusted: AdjustedLens) -> NDArray[np.uint8]:
    """An arrow from every corner's expected place, magnified, coloured by its length; the cells' mean over them.

    Noise points anywhere; a lens model that does not fit shows as a pattern of the thick arrows.

    Returns:
        (h, 1200, 3) BGR.
    """
    lens = adjusted.lens
    scale = WIDTH / lens.width
    seen = np.concatenate([view.pixels for view in views]).astype(float)
    residuals = np.concatenate(adjusted.residuals)
    lengths = np.linalg.norm(residuals, axis=1)
    typical = max(float(np.quantile(lengths, 0.9)), 1e-6)
    gain = TYPICAL / typical
    canvas = np.full((TITLE + round(lens.height * scale), WIDTH, 3), PAPER, np.uint8)
    starts = (seen - residuals + 0.5) * scale + [0, TITLE]
    for start, r, length in zip(starts, residuals, lengths, strict=True):
        _arrow(canvas, start, gain * r, _colour(length / (2 * typical)), 1)
    for start, r in _cell_means(starts, residuals, canvas.shape[0]):
        _arrow(canvas, start, gain * r, FIELD, 3)
    title = f"{name}: RMS {adjusted.rms_px:.3f} px, {len(seen)} corners, arrows x {gain:.0f}; thick: mean of a cell"
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
