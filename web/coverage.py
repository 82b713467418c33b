# SPDX-License-Identifier: BSD-3-Clause
"""Where in its image a camera has seen roundels: what tells a person where to wave the wand next."""

from collections.abc import Mapping
from itertools import zip_longest

import cv2
import numpy as np
from numpy.typing import NDArray

from camera_node.protocol.messages import Detections

WIDTH = 160  # pixels of the small picture
CELLS = 8  # of the grid that the share counts, in each direction
TITLE = 18  # pixels above each picture, for its camera's name
PAPER, INK = np.array([24, 28, 38], np.uint8), np.array([64, 200, 170], np.uint8)


class Coverage:
    """A small picture of one camera's image, inked where roundels were."""

    def __init__(self, width: int, height: int) -> None:
        self.size = (width, height)
        self.inked = np.zeros((max(1, round(WIDTH * min(height / width, 4.0))), WIDTH), bool)
        self.cells = np.zeros((CELLS, CELLS), bool)

    def add(self, detections: Detections) -> None:
        """Ink the roundels of one frame."""
        uv = np.frombuffer(detections.uv, "<f8").reshape(-1, 2)
        share = (uv + 0.5) / self.size
        share = share[((share >= 0) & (share < 1)).all(axis=1)]
        rows, columns = self.inked.shape
        v, u = (share[:, 1] * rows).astype(int), (share[:, 0] * columns).astype(int)
        for dv in (-1, 0, 1):
            for du in (-1, 0, 1):
                self.inked[np.clip(v + dv, 0, rows - 1), np.clip(u + du, 0, columns - 1)] = True
        self.cells[(share[:, 1] * CELLS).astype(int), (share[:, 0] * CELLS).astype(int)] = True

    @property
    def share(self) -> float:
        """Which part of the image has been visited, 0 to 1, in cells of an eighth of its width and height."""
        return float(self.cells.mean())

    def image(self) -> NDArray[np.uint8]:
        """(rows, 160, 3) RGB."""
        return np.where(self.inked[..., None], INK, PAPER)


def montage(pictures: Mapping[str, Coverage]) -> NDArray[np.uint8]:
    """All cameras' pictures, two in a row, their names and shares above them: (h, 2 * 160 + 8, 3) RGB."""
    tiles = [_entitle(name, pictures[name]) for name in sorted(pictures)]
    height = max((len(tile) for tile in tiles), default=1)
    rows = []
    for left, right in zip_longest(tiles[::2], tiles[1::2], fillvalue=np.full((1, 1, 3), 36, np.uint8)):
        row = np.full((height, 2 * WIDTH + 8, 3), 36, np.uint8)
        row[: len(left), :WIDTH] = left
        row[: len(right), WIDTH + 8 : WIDTH + 8 + right.shape[1]] = right
        rows.append(row)
    return np.concatenate(rows) if rows else np.zeros((1, 2 * WIDTH + 8, 3), np.uint8)


def _entitle(name: str, picture: Coverage) -> NDArray[np.uint8]:
    tile = np.full((TITLE + len(picture.inked), WIDTH, 3), 36, np.uint8)
    tile[TITLE:] = picture.image()
    text = f"{name[:16]} {100 * picture.share:.0f} %"
    cv2.putText(tile, text, (2, TITLE - 6), cv2.FONT_HERSHEY_SIMPLEX, 0.4, (205, 210, 220), 1, cv2.LINE_AA)
    return tile
