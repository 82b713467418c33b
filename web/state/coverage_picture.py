# SPDX-License-Identifier: BSD-3-Clause
"""Draws for each camera where in its image roundels were detected, to show where the wand is still missing."""

from collections.abc import Mapping
from itertools import zip_longest

import cv2
import numpy as np
from numpy.typing import NDArray

from calib.rig.coverage import Coverage
from camera_node.protocol.messages import Detections

WIDTH = 160  # pixels of one picture
MAX_ASPECT = 4.0  # height over width of one picture
CELLS = (8, 8)  # of the grid for the covered share
TITLE = 18  # pixels above each picture for the camera's name
GAP = 8  # pixels between two pictures
EMPTY, COVERED = np.array([24, 28, 38], np.uint8), np.array([64, 200, 170], np.uint8)
BACKGROUND, TEXT = 36, (205, 210, 220)


class CoveragePicture:
    """A picture of one camera's image that shows where roundels were detected."""

    def __init__(self, width: int, height: int) -> None:
        self.size = (width, height)
        self._mask = np.zeros((max(1, round(WIDTH * min(height / width, MAX_ASPECT))), WIDTH), bool)
        self._coverage = Coverage(np.zeros(CELLS, np.int64))

    def add(self, detections: Detections) -> None:
        """Mark the roundels of one frame."""
        uv = np.frombuffer(detections.uv, "<f8").reshape(-1, 2)
        self._coverage += Coverage.of(uv, *self.size, CELLS)
        relative = (uv + 0.5) / self.size
        relative = relative[((relative >= 0) & (relative < 1)).all(axis=1)]
        rows, columns = self._mask.shape
        v, u = (relative[:, 1] * rows).astype(int), (relative[:, 0] * columns).astype(int)
        for dv in (-1, 0, 1):
            for du in (-1, 0, 1):
                self._mask[np.clip(v + dv, 0, rows - 1), np.clip(u + du, 0, columns - 1)] = True

    @property
    def n_marked(self) -> int:
        """Number of marked pixels; it grows with each change of the picture."""
        return int(np.count_nonzero(self._mask))

    @property
    def share(self) -> float:
        """The covered share of the image, 0 to 1, counted in 8 x 8 cells."""
        return self._coverage.share()

    def pixels(self) -> NDArray[np.uint8]:
        """Return the picture, (rows, 160, 3) RGB."""
        return np.where(self._mask[..., None], COVERED, EMPTY)


def montage(pictures: Mapping[str, CoveragePicture]) -> NDArray[np.uint8]:
    """Return the pictures of all cameras, two in a row, with names and shares: (h, 2 * 160 + 8, 3) RGB."""
    tiles = [_tile(name, pictures[name]) for name in sorted(pictures)]
    height = max((len(tile) for tile in tiles), default=1)
    rows = []
    nothing = np.full((1, 1, 3), BACKGROUND, np.uint8)
    for left, right in zip_longest(tiles[::2], tiles[1::2], fillvalue=nothing):
        row = np.full((height, 2 * WIDTH + GAP, 3), BACKGROUND, np.uint8)
        row[: len(left), :WIDTH] = left
        row[: len(right), WIDTH + GAP : WIDTH + GAP + right.shape[1]] = right
        rows.append(row)
    return np.concatenate(rows) if rows else np.zeros((1, 2 * WIDTH + GAP, 3), np.uint8)


def _tile(name: str, picture: CoveragePicture) -> NDArray[np.uint8]:
    pixels = picture.pixels()
    tile = np.full((TITLE + len(pixels), WIDTH, 3), BACKGROUND, np.uint8)
    tile[TITLE:] = pixels
    text = f"{name[:16]} {100 * picture.share:.0f} %"
    cv2.putText(tile, text, (2, TITLE - 6), cv2.FONT_HERSHEY_SIMPLEX, 0.4, TEXT, 1, cv2.LINE_AA)
    return tile
