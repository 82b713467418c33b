# SPDX-License-Identifier: BSD-3-Clause
"""An arena of which one camera is moved, and frames that turn black: for the tests of what judges cameras."""

import msgspec
import numpy as np

from camera_node.geometry.pose import Pose, rotation_from_vector
from fusion.model.frames import CalibratedFrame
from tests.fusion.synthetic import TRIANGLE, WIDE, Arena, line

MOVE_S = 1.0  # after the robots agreed with the rig
ROBOTS = {"a": TRIANGLE, "b": WIDE}
MOTIONS = {
    "a": line((-0.5, 0.3, 0.15), (0.25, -0.1, 0), turn=(0, 0, 0.5)),
    "b": line((0.5, -0.3, 0.5), (-0.2, 0.15, 0), turn=(0, 0, -0.4)),
}


AXIS = 0.6, 0.64, 0.48


def moved(turn_deg: float, shift_m: float, axis: tuple[float, float, float] = AXIS) -> tuple[Arena, Arena]:
    """An arena, and the same with cam1 rotated about an axis of its own frame, and shifted along one that is not
    parallel to a coordinate axis."""
    before = Arena(ROBOTS, MOTIONS, sigma_px=0.1)
    T = before.cameras["cam1"].matrix()
    T[:3, :3] = T[:3, :3] @ rotation_from_vector(np.radians(turn_deg) * np.array(axis))
    T[:3, 3] += shift_m * np.array([0.48, -0.6, 0.64])
    cameras = dict(before.cameras)
    cameras["cam1"] = msgspec.structs.replace(cameras["cam1"], T_world_cam=Pose.from_matrix(T))
    return before, Arena(ROBOTS, MOTIONS, cameras=cameras, sigma_px=0.1)


def black(frame: CalibratedFrame) -> CalibratedFrame:
    """The frame without what it shows."""
    return frame.select(np.empty(0, np.intp))
