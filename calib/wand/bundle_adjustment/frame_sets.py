# SPDX-License-Identifier: BSD-3-Clause
"""Moments of a wave: frames of different cameras that belong together, and which of many moments are worth while."""

import numpy as np

from calib.wand.detections import WandDetections
from camera_node.arrays import Array, Index, Mask

MAX_SPREAD_S = 0.1  # a hand moves decimetres in this time
DENSE_S = (
    0.02  # within which frames are one moment however fast cameras are: the motion between is interpolated
)
WINDOW = 8  # moments in a row that are chosen together, so that what happens between them is known
CELLS = (4, 3)  # of an image, for coverage


def group_instants(t_s: Array, camera: Index, period_s: float) -> Index:
    """Which moment each of F frames, in order of time, belongs to (F,); -1 where only one camera has it.

    A moment is a run of frames within half of a frame period, or within a few milliseconds if that is longer.
    """
    spread = min(max(period_s / 2, min(period_s, DENSE_S)), MAX_SPREAD_S) if period_s else MAX_SPREAD_S
    found, first, instant = np.empty(len(t_s), np.intp), -np.inf, -1
    for k, t in enumerate(t_s.tolist()):
        if t - first > spread + 1e-6:
            first, instant = t, instant + 1
        found[k] = instant
    pairs = np.unique(np.column_stack([found, camera]), axis=0)
    several = np.bincount(pairs[:, 0], minlength=1) >= 2
    return np.where(several, np.cumsum(several) - 1, -1)[found]


def choose_instants(seen: WandDetections, instant: Index, sizes: Array, budget: int) -> Mask:
    """Which moments (K,) to use, at most about `budget`: all, or runs of them that cover every image evenly.

    Greedy: each next run is the one whose sightings fall where the fewest have fallen so far.

    Args:
        seen: sightings of all moments.
        instant: (n,) their moment.
        sizes: (C, 2) width and height of the cameras' images.
    """
    count = int(instant.max(initial=-1)) + 1
    if count <= budget:
        return np.ones(count, bool)
    share = np.clip(seen.uv / sizes[seen.camera], 0, 0.999)
    column, row = (share * CELLS).astype(np.intp).T
    cell = (seen.camera * CELLS[0] + column) * CELLS[1] + row
    held = np.zeros((-(-count // WINDOW), len(sizes) * CELLS[0] * CELLS[1]))
    np.add.at(held, (instant // WINDOW, cell), 1.0)
    total, chosen, open_runs = np.zeros(held.shape[1]), np.zeros(count, bool), np.ones(len(held), bool)
    for _ in range(budget // WINDOW):
        gain = np.where(open_runs, held @ (1 / (1 + total)), -1.0)
        best = int(gain.argmax())
        open_runs[best] = False
        total += held[best]
        chosen[best * WINDOW : (best + 1) * WINDOW] = True
    return chosen
