# SPDX-License-Identifier: BSD-3-Clause
"""Groups frames of different cameras into frame sets, and chooses which frame sets the adjustment uses."""

import numpy as np

from calib.wand.detections import WandDetections
from calib.wand.tracks import SAME_S
from camera_node.foundation.arrays import Array, Index, Mask

WINDOW = 8  # consecutive frame sets that are chosen together, so that the motion between them is estimated
CELLS = (4, 3)  # columns and rows of an image, for coverage


def group_frames(t_s: Array, camera: Index, spread_s: float) -> Index:
    """The frame set of each of F frames, (F,); -1 where only one camera has a frame.

    A frame set is a run of frames within `spread_s`.

    Args:
        t_s: (F,) true capture times, ascending.
        camera: (F,) camera of each frame.
        spread_s: longest time between the frames of a set; 0 where only equal times are simultaneous.
    """
    sets, first, current = np.empty(len(t_s), np.intp), -np.inf, -1
    for k, t in enumerate(t_s.tolist()):
        if t - first > spread_s + SAME_S:
            first, current = t, current + 1
        sets[k] = current
    pairs = np.unique(np.column_stack([sets, camera]), axis=0)
    several = np.bincount(pairs[:, 0], minlength=1) >= 2
    return np.where(several, np.cumsum(several) - 1, -1)[sets]


def choose_frame_sets(detections: WandDetections, frame_set: Index, sizes: Array, budget: int) -> Mask:
    """Which of K frame sets to use, at most about `budget`: all, or windows of them that cover all images evenly.

    Greedy: each next window is the one with most detections in cells that have few so far.

    Args:
        detections: n detections in frame sets.
        frame_set: (n,) their frame set.
        sizes: (C, 2) width and height of the cameras' images.
        budget: number of frame sets.
    """
    count = int(frame_set.max(initial=-1)) + 1
    if count <= budget:
        return np.ones(count, bool)
    position = np.clip(detections.uv / sizes[detections.camera], 0, 0.999)
    column, row = (position * CELLS).astype(np.intp).T
    cell = (detections.camera * CELLS[0] + column) * CELLS[1] + row
    counts = np.zeros((-(-count // WINDOW), len(sizes) * CELLS[0] * CELLS[1]))
    np.add.at(counts, (frame_set // WINDOW, cell), 1.0)
    total, chosen, available = np.zeros(counts.shape[1]), np.zeros(count, bool), np.ones(len(counts), bool)
    for _ in range(budget // WINDOW):
        gain = np.where(available, counts @ (1 / (1 + total)), -1.0)
        best = int(gain.argmax())
        available[best] = False
        total += counts[best]
        chosen[best * WINDOW : (best + 1) * WINDOW] = True
    return chosen
