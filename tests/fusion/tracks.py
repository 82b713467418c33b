# SPDX-License-Identifier: BSD-3-Clause
"""Tracks the frames of a synthetic arena, and compares the poses with the truth."""

import numpy as np

from camera_node.geometry.pose import rotation_from_wxyz
from fusion.model.frames import CalibratedFrame
from fusion.model.limits import Limits
from fusion.protocol.pose_messages import RobotPose
from fusion.server.frame_synchronizer import FrameSynchronizer
from fusion.tracking.result import TrackingResult
from fusion.tracking.tracker import Tracker
from tests.fusion.synthetic import Arena


def track(arena: Arena, frames: list[CalibratedFrame], limits: Limits | None = None) -> list[TrackingResult]:
    """The results of all frame sets."""
    tracker, synchronizer = Tracker(arena.cameras, arena.robots, limits), FrameSynchronizer(33_333_333)
    closed = []
    for frame in frames:
        synchronizer.add(frame)
        closed += synchronizer.take(frame.t_ns)
    return [tracker.track(frame_set) for frame_set in (*closed, *synchronizer.finish())]


def poses_of(results: list[TrackingResult], robot: str) -> list[RobotPose]:
    """The poses of a robot in every state."""
    return [pose for result in results for pose in result.poses if pose.robot == robot]


def errors(arena: Arena, poses: list[RobotPose]) -> np.ndarray:
    """(N, 6) errors of rotation (body frame) and position."""
    rows = []
    for pose in poses:
        R, p = arena.truth(pose.robot, pose.t_ns)
        E = R.T @ rotation_from_wxyz(pose.quaternion_wxyz)
        rows.append([E[2, 1] - E[1, 2], E[0, 2] - E[2, 0], E[1, 0] - E[0, 1], *2 * (pose.position - p)])
    return np.array(rows).reshape(-1, 6) / 2
