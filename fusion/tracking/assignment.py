# SPDX-License-Identifier: BSD-3-Clause
"""Assigns detections to markers frame by frame, by the lowest total cost."""

import numpy as np
from scipy.optimize import linear_sum_assignment

from camera_node.foundation.arrays import Array, Index

UNASSIGNED_COST = 1e4  # of a marker without a detection: above any sum of costs within gates
MAX_JOINT = 150  # contested pairs that one assignment solves for all frames together


def assign(pairs: Index, cost: Array, frame: Index) -> Index:
    """Choose as many pairs as possible in each frame at the lowest total cost.

    Args:
        pairs: (2, K) rows of markers and detections.
        cost: (K,), each below `UNASSIGNED_COST`.
        frame: (N,) of the detections.

    Returns:
        the chosen columns of `pairs`; pairs without a rival are chosen directly.
    """
    marker, detection = pairs
    view = frame[detection] * (np.max(marker, initial=0) + 1) + marker  # of a marker in a frame
    rivals = np.maximum(np.bincount(view)[view], np.bincount(detection)[detection])
    alone, contested = np.flatnonzero(rivals == 1), np.flatnonzero(rivals > 1)
    at = frame[detection[contested]]
    groups = [contested] if len(contested) < MAX_JOINT else [contested[at == k] for k in set(at.tolist())]
    chosen = [rows[_solve_assignment(view[rows], detection[rows], cost[rows])] for rows in groups]
    return np.concatenate([alone, *chosen])


def _solve_assignment(view: Index, detection: Index, cost: Array) -> Index:
    i, n = _renumber(view)
    j, m = _renumber(detection)
    costs, number = np.full((n, m), UNASSIGNED_COST), np.full((n, m), -1)
    costs[i, j], number[i, j] = cost, np.arange(len(cost))
    chosen = number[linear_sum_assignment(costs)]
    return chosen[chosen >= 0]


def _renumber(rows: Index) -> tuple[Index, int]:
    """Rows renumbered from 0 without gaps, and their count."""
    new = np.cumsum(np.bincount(rows) > 0)
    return new[rows] - 1, int(new[-1]) if len(new) else 0
