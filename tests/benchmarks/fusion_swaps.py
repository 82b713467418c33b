# SPDX-License-Identifier: BSD-3-Clause
"""Identity errors of crossing robots."""

from dataclasses import dataclass

import numpy as np

from fusion.tracking.tracker import Tracker
from tests.benchmarks.fusion_accuracy import frame_sets
from tests.benchmarks.fusion_load import START_NS, Load

WRONG_M = 0.05  # position error above which a tracked robot has the wrong identity


@dataclass(frozen=True)
class Identity:
    """Wrong tracked poses, changes from correct to wrong, and the share of tracked robots."""

    wrong: int
    swaps: int
    tracked: float


def identity(load: Load, seconds: float) -> Identity:
    """Of the robots of a load."""
    tracker = Tracker(load.rig, load.bodies)
    was_wrong, wrong_poses, swaps, tracked = np.zeros(load.robots, bool), 0, 0, []
    for frame_set in frame_sets(load, seconds):
        tracker.track(frame_set)
        truth = load.paths.at((frame_set.t_ns - START_NS) * 1e-9)
        alive = tracker.table.tracked
        wrong = alive & (np.linalg.norm(tracker.table.states.p - truth.p, axis=1) > WRONG_M)
        swaps += int((wrong & ~was_wrong).sum())
        wrong_poses += int(wrong.sum())
        was_wrong = wrong
        tracked.append(alive.mean())
    return Identity(wrong_poses, swaps, float(np.mean(tracked)))
