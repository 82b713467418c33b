# SPDX-License-Identifier: BSD-3-Clause
"""Velocities in the body's frame and their covariances, as ROS and MAVLink have them; many poses at a time."""

from collections.abc import Sequence

import numpy as np

from camera_node.foundation.arrays import Array
from camera_node.geometry.pose import rotation_from_wxyz, skew
from fusion.protocol.pose_messages import RobotPose


def rotations(poses: Sequence[RobotPose]) -> Array:
    """(N, 3, 3) rotations, body to world."""
    return rotation_from_wxyz([pose.quaternion_wxyz for pose in poses])


def twists(poses: Sequence[RobotPose], R: Array) -> Array:
    """(N, 2, 3) velocity and angular velocity in the frames of the bodies, whose rotations are `R` (N, 3, 3)."""
    return np.array([(pose.velocity, pose.angular_velocity) for pose in poses]) @ R


def covariances(poses: Sequence[RobotPose], R: Array, twist: Array) -> Array:
    """(N, 12, 12) covariances of position, rotation (about the world's axes), velocity, angular velocity (body).

    With the true rotation R exp(theta), the error of v_body = R^T v is R^T dv + v_body x theta to first order, and that
    of the angular velocity has the same form.

    Args:
        poses: N poses with their own covariances.
        R: (N, 3, 3) their rotations.
        twist: (N, 2, 3) their `twists`.
    """
    J = np.zeros(
        (len(poses), 12, 12)
    )  # columns: rotation (body), position, angular velocity, velocity (world)
    J[:, 0:3, 3:6], J[:, 3:6, 0:3] = np.eye(3), R
    J[:, 6:9, 9:12] = J[:, 9:12, 6:9] = np.swapaxes(R, 1, 2)
    J[:, 6:12, 0:3] = skew(twist).reshape(-1, 6, 3)
    own = np.frombuffer(b"".join(pose.covariance for pose in poses), "<f4").reshape(-1, 12, 12).astype(float)
    return J @ own @ np.swapaxes(J, 1, 2)
