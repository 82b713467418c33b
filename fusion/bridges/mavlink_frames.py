# SPDX-License-Identifier: BSD-3-Clause
"""An arena's poses in MAVLink's frames: forward, right, down (FRD), for the world and for the body.

docs/bridges.md has a drawing. `R_frd_world` turns the world's axes about z by the heading and then about x by 180
degrees, so that z points down; the body's axes are turned in the same way. All rotations are proper, so velocities and
angular velocities transform alike.
"""

import math
from dataclasses import dataclass

import numpy as np

from camera_node.foundation.arrays import Array
from camera_node.foundation.errors import ConfigError
from fusion.bridges.body_motion import covariances, rotations, twists
from fusion.protocol.pose_messages import RobotPose

DOWN = np.diag([1.0, -1.0, -1.0])  # turns forward, left, up to forward, right, down
MIN_COS_PITCH = (
    0.02  # roll and yaw of a body that points straight up are not defined: their covariance is bounded
)
UPPER = np.triu_indices(6)


@dataclass(frozen=True)
class FrdPose:
    """A pose in MAVLink's frames.

    Attributes:
        position: (3,) in the local FRD frame, metres.
        rotation: (3, 3) from the body's FRD frame to the local one.
        twist: (2, 3) velocity, m/s, and angular velocity, rad/s, in the body's FRD frame.
        pose_covariance: (6, 6) of x, y, z, roll, pitch, yaw.
        twist_covariance: (6, 6) of the velocity and the angular velocity.
    """

    position: Array
    rotation: Array
    twist: Array
    pose_covariance: Array
    twist_covariance: Array


class FrdFrames:
    """The local FRD frame and a body's.

    Args:
        origin_m: the local frame's origin in the arena's world, metres.
        heading_deg: direction of the local frame's x axis in the arena's world, from x towards y.
        forward_deg: direction of the vehicle's nose in the robot's body as in robots.yaml, from x towards y.

    Raises:
        ConfigError: a value is not finite.
    """

    def __init__(
        self, origin_m: tuple[float, float, float], heading_deg: float = 0.0, forward_deg: float = 0.0
    ) -> None:
        if not all(map(math.isfinite, (*origin_m, heading_deg, forward_deg))):
            raise ConfigError("--origin-m, --heading-deg and --forward-deg must be finite numbers")
        self._origin = np.array(origin_m)
        self._R_frd_world = DOWN @ _turn(-heading_deg)
        self._R_frd_body = DOWN @ _turn(-forward_deg)

    def convert(self, pose: RobotPose) -> FrdPose:
        """The pose in the local frame."""
        A, B, R = self._R_frd_world, self._R_frd_body, rotations([pose])
        twist = twists([pose], R)
        own = covariances([pose], R, twist)[0]
        rotation = A @ R[0] @ B.T
        J = _blocks(A, roll_pitch_yaw_rates(rotation) @ A)
        K = _blocks(B, B)
        return FrdPose(
            position=A @ (np.array(pose.position) - self._origin),
            rotation=rotation,
            twist=twist[0] @ B.T,
            pose_covariance=J @ own[:6, :6] @ J.T,
            twist_covariance=K @ own[6:, 6:] @ K.T,
        )


def roll_pitch_yaw(R: Array) -> tuple[float, float, float]:
    """Roll, pitch, yaw, radians, of R = Rz(yaw) Ry(pitch) Rx(roll)."""
    pitch = math.asin(min(1.0, max(-1.0, -R[2, 0])))
    return math.atan2(R[2, 1], R[2, 2]), pitch, math.atan2(R[1, 0], R[0, 0])


def roll_pitch_yaw_rates(R: Array) -> Array:
    """(3, 3) derivative of roll, pitch, yaw with respect to a small turn of R about the fixed axes."""
    _, pitch, yaw = roll_pitch_yaw(R)
    cosine = max(math.cos(pitch), MIN_COS_PITCH)
    c, s, tangent = math.cos(yaw), math.sin(yaw), math.sin(pitch) / cosine
    return np.array([[c / cosine, s / cosine, 0.0], [-s, c, 0.0], [c * tangent, s * tangent, 1.0]])


def upper_triangle(C: Array) -> list[float]:
    """The 21 values of a covariance (6, 6) in MAVLink's order: row by row from the diagonal on."""
    return C[UPPER].tolist()


def _turn(degrees: float) -> Array:
    c, s = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def _blocks(A: Array, B: Array) -> Array:
    J = np.zeros((6, 6))
    J[:3, :3], J[3:, 3:] = A, B
    return J
