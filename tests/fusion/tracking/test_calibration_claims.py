# SPDX-License-Identifier: BSD-3-Clause
"""Published positions claim the error of the calibration, which is the same for all markers in a view."""

from dataclasses import replace
from itertools import groupby

import msgspec
import numpy as np
import pytest

from calib.rig.camera import Camera
from fusion.model.frames import CalibratedFrame, FrameSet
from fusion.model.limits import Limits
from fusion.model.robots import Robot
from fusion.protocol.pose_messages import RobotPose
from fusion.tracking.tracker import Tracker
from tests.fusion.synthetic import SINGLE, TRIANGLE, Arena, circle

FLOOR_PX = Limits().sigma_floor_px
RIGS, FRAMES = 8, 4


def displaced(frame: CalibratedFrame, camera: Camera, shift: np.ndarray) -> CalibratedFrame:
    """The frame of a camera that is calibrated with an error of `shift` (2,), pixels."""
    moved = replace(frame.roundels, uv=frame.roundels.uv + shift)
    return CalibratedFrame.measure(frame.camera, frame.t_ns, moved, camera)


def squared_error(robot: Robot, rng: np.random.Generator) -> float:
    """Of the last position of a robot in front of cameras with errors, over its claim, for each coordinate."""
    arena = Arena({"robot": robot}, {"robot": circle(1e9, 0.4)}, phases=(0.0,) * 4, sigma_px=0.005)
    shifts = {name: FLOOR_PX * rng.standard_normal(2) for name in arena.cameras}
    tracker = Tracker(arena.cameras, arena.robots)
    poses: list[RobotPose] = []
    for t_ns, frames in groupby(arena.frames(FRAMES), lambda frame: frame.t_ns):
        seen = tuple(displaced(f, arena.cameras[f.camera], shifts[f.camera]) for f in frames)
        poses = list(tracker.track(FrameSet(t_ns, seen)).poses)
    pose = poses[0]
    error = np.array(pose.position) - arena.truth("robot", pose.t_ns)[1]
    return float(error @ np.linalg.solve(pose.covariance_matrix[3:6, 3:6], error)) / 3


@pytest.mark.parametrize(
    "robot",
    [msgspec.structs.replace(SINGLE, start_m=(0.4, 0.0, 0.2)), TRIANGLE],
    ids=["one marker", "three markers"],
)
def test_errors_that_all_markers_of_a_view_share_are_claimed(robot: Robot):
    """The mean over rigs is 1, with a standard deviation of sqrt(2 / 3 RIGS) = 0.3; within four of these. Where markers
    count as independent, three of them have 3."""
    rng = np.random.default_rng(6)
    mean = np.mean([squared_error(robot, rng) for _ in range(RIGS)])
    assert mean == pytest.approx(1.0, abs=4 * (2 / (3 * RIGS)) ** 0.5)
