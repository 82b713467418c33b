# SPDX-License-Identifier: BSD-3-Clause
"""Pairs of points that are each other's nearest."""

import numpy as np

from camera_node.foundation.arrays import Array, Index


def mutual_nearest(expected: Array, seen: Array, gate: float) -> tuple[Index, Index]:
    """Rows of expected (N, D) and seen (M, D) points that are each other's nearest, within the gate; NaN is nowhere."""
    if not len(expected) or not len(seen):
        return np.empty(0, np.intp), np.empty(0, np.intp)
    off = np.linalg.norm(np.nan_to_num(expected, nan=np.inf)[:, None] - seen[None], axis=2)
    rows, found = np.arange(len(expected)), off.argmin(1)
    good = (off.argmin(0)[found] == rows) & (off[rows, found] < gate)
    return rows[good], found[good]
