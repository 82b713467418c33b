# SPDX-License-Identifier: BSD-3-Clause
"""Who is who: robots that cross, and what is said of them while they do."""

from dataclasses import dataclass

import numpy as np

from fusion.tracking.tracker import Tracker
from tests.benchmarks.fusion_accuracy import instants
from tests.benchmarks.fusion_load import START_NS, Load

WRONG_M = 0.05  # a tracked robot that is further from where it truly is, is another one, or nonsense


@dataclass(frozen=True)
class Identity:
    """Poses told as tracked that are wrong, changes from right to wrong, and the share of robots tracked."""

    wrong: int
    swaps: int
    tracked: float


def identity(load: Load, seconds: float) -> Identity:
    """Of a load's robots over its whole time."""
    tracker = Tracker(load.rig, load.bodies)
    was_wrong, wrong_poses, swaps, tracked = np.zeros(load.robots, bool), 0, 0, []
    for instant in instants(load, seconds):
        tracker.track(instant)
        truth = load.paths.at((instant.t_ns - START_NS) * 1e-9)
        alive = tracker.table.tracked
        wrong = alive & (np.linalg.norm(tracker.table.states.p - truth.p, axis=1) > WRONG_M)
        swaps += int((wrong & ~was_wrong).sum())
        wrong_poses += int(wrong.sum())
        was_wrong = wrong
        tracked.append(alive.mean())
    return Identity(wrong_poses, swaps, float(np.mean(tracked)))
