# SPDX-License-Identifier: BSD-3-Clause
"""Numbers that stay with roundels from frame to frame."""

import numpy as np
from numpy.typing import NDArray

MOTION = 1.0  # diameters that a roundel may move from one frame to the next


class Tracks:
    """Joins each roundel with the one of the previous frame that is nearest to it, and it to that one."""

    def __init__(self) -> None:
        self._next = 0
        self._uv = np.empty((0, 2))
        self._number = np.empty(0, np.int32)

    def follow(self, uv: NDArray[np.float64], major_px: NDArray[np.float64]) -> NDArray[np.int32]:
        """Track numbers (N,) of roundels at `uv` (N, 2) of diameters `major_px` (N,); what is new gets a new one."""
        number = np.full(len(uv), -1, np.int32)
        if len(uv) and len(self._uv):
            apart = np.linalg.norm(uv[:, None] - self._uv, axis=2)
            nearest = apart.argmin(axis=1)
            rows = np.arange(len(uv))
            mutual = apart.argmin(axis=0)[nearest] == rows
            same = mutual & (apart[rows, nearest] <= MOTION * major_px)
            number[same] = self._number[nearest[same]]
        new = number < 0
        number[new] = self._next + np.arange(new.sum())
        self._next = (self._next + int(new.sum())) % 2**30
        self._uv, self._number = uv.copy(), number
        return number
