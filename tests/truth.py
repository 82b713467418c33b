# SPDX-License-Identifier: BSD-3-Clause
"""Reads the cameras of a recording's truth.json, the format of ../shared/data/arena_small."""

from typing import Any

import numpy as np

from calib.rig.camera import Camera
from camera_node.geometry.pose import Pose, invert


def true_camera(entry: dict[str, Any], placed: bool = True) -> Camera:
    """A camera of truth.json, with its pose or with the intrinsics alone."""
    K = entry["K"]
    return Camera(
        width=entry["width"],
        height=entry["height"],
        fx=K[0][0],
        fy=K[1][1],
        cx=K[0][2],
        cy=K[1][2],
        distortion=tuple(entry["dist"]),
        T_world_cam=Pose.from_matrix(invert(np.array(entry["T_cam_world"]))) if placed else None,
    )
