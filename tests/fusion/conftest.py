# SPDX-License-Identifier: BSD-3-Clause
"""Running frames through the tracker."""

import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parent))

from fusion.model.frames import CalibratedFrame
from fusion.model.limits import Limits
from fusion.protocol.messages import RobotPose
from fusion.server.frame_synchronizer import FrameSynchronizer
from fusion.tracking.result import TrackingResult
from fusion.tracking.tracker import Tracker
from tests.fusion.synthetic import Arena


def fuse(arena: Arena, frames: list[CalibratedFrame], limits: Limits | None = None) -> list[TrackingResult]:
    """All instants of the frames."""
    tracker, instants = Tracker(arena.cameras, arena.robots, limits), FrameSynchronizer(33_333_333)
    closed = []
    for frame in frames:
        instants.add(frame)
        closed += instants.take(frame.t_ns)
    return [tracker.track(instant) for instant in (*closed, *instants.finish())]


def poses_of(fused: list[TrackingResult], robot: str) -> list[RobotPose]:
    """The robot's poses, whatever their state."""
    return [pose for instant in fused for pose in instant.poses if pose.robot == robot]


def errors(arena: Arena, poses: list[RobotPose]) -> np.ndarray:
    """(N, 6) rotation (body) and position errors of poses."""
    from camera_node.geometry.pose import rotation_from_wxyz

    rows = []
    for pose in poses:
        R, p = arena.truth(pose.robot, pose.t_ns)
        E = R.T @ rotation_from_wxyz(pose.quaternion_wxyz)
        rows.append([E[2, 1] - E[1, 2], E[0, 2] - E[2, 0], E[1, 0] - E[0, 1], *2 * (pose.position - p)])
    return np.array(rows).reshape(-1, 6) / 2


@pytest.fixture
def run_arena() -> Callable[..., tuple[list[TrackingResult], Callable[[str], list[RobotPose]]]]:
    """`run_arena(arena, n)`: the fused instants of n frames a camera, and a function robot -> its poses."""

    def run(arena: Arena, n: int = 30, limits: Limits | None = None):
        fused = fuse(arena, arena.frames(n), limits)
        return fused, lambda robot: poses_of(fused, robot)

    return run
