# SPDX-License-Identifier: BSD-3-Clause
"""Encodes a robot's pose as ROS 2 messages: little-endian CDR, the bytes of rmw implementations.

The conventions are ROS's (REP 103, REP 105, the comments of `geometry_msgs`): quaternions x, y, z, w; covariances of
position, then of rotation about the frame's fixed axes; a twist in the frame of the moving body.
"""

import struct
from collections.abc import Sequence

import numpy as np

from camera_node.arrays import Array
from camera_node.detection.relative import LocatedRoundels
from camera_node.geometry.pose import rotation_with_z, wxyz_from_rotation
from camera_node.protocol.relative import RelativePositions
from fusion.bridges.body_motion import covariances, rotations, twists
from fusion.protocol.messages import RobotPose

# ROS 2 name of a message -> hash of its definition (REP 2016), the same in all releases since Iron
TYPE_HASHES = {
    "geometry_msgs/msg/PoseStamped": "10f3786d7d40fd2b54367835614bff85d4ad3b5dab62bf8bca0cc232d73b4cd8",
    "geometry_msgs/msg/PoseWithCovarianceStamped": "26432f9803e43727d3c8f668d1fdb3c630f548af631e2f4e31382371bfea3b6e",
    "nav_msgs/msg/Odometry": "3cc97dc7fb7502f8714462c526d369e35b603cfc34d946e3f2eda2766dfec6e0",
    "tf2_msgs/msg/TFMessage": "e369d0f05a23ae52508854b66f6aa0437f3449d652e8cbf22d5abe85d020f087",
}

ANY_ANGLE = np.pi**2 / 3  # variance of an angle of which nothing is known, square radians


class Cdr:
    """Encodes CDR. The offset of each number behind the four-byte header is a multiple of its size."""

    def __init__(self) -> None:
        self._data = bytearray()

    def u32(self, *values: int) -> None:
        self._align(4)
        self._data += struct.pack(f"<{len(values)}I", *values)

    def doubles(self, *values: float) -> None:
        self._align(8)
        self._data += struct.pack(f"<{len(values)}d", *values)

    def array(self, values: Array) -> None:
        self._align(8)
        self._data += np.asarray(values, "<f8").tobytes()

    def text(self, value: str) -> None:
        data = value.encode() + b"\0"
        self.u32(len(data))
        self._data += data

    def finish(self) -> bytes:
        return b"\0\1\0\0" + self._data

    def _align(self, size: int) -> None:
        self._data += bytes(-len(self._data) % size)


def pose_stamped(pose: RobotPose, frame: str) -> bytes:
    """`geometry_msgs/msg/PoseStamped` in the frame named `frame`, which is the arena's world."""
    cdr = Cdr()
    _put_header(cdr, pose, frame)
    _put_pose(cdr, pose)
    return cdr.finish()


def odometries(poses: Sequence[RobotPose], frame: str, children: Sequence[str]) -> list[bytes]:
    """`nav_msgs/msg/Odometry` of each pose: the pose in `frame`, the twist in the body's frame, both covariances.

    Args:
        poses: N poses; arrays of all of them cost little more than those of one.
        frame: the name of the arena's world.
        children: the N names of the bodies' frames.
    """
    if not poses:
        return []
    R = rotations(poses)
    twist = twists(poses, R)
    C = covariances(poses, R, twist)
    messages = []
    for k, (pose, child) in enumerate(zip(poses, children, strict=True)):
        cdr = Cdr()
        _put_header(cdr, pose, frame)
        cdr.text(child)
        _put_pose(cdr, pose)
        cdr.array(C[k, :6, :6])
        cdr.array(twist[k])
        cdr.array(C[k, 6:, 6:])
        messages.append(cdr.finish())
    return messages


def transforms(poses: Sequence[RobotPose], frame: str, children: Sequence[str]) -> bytes:
    """`tf2_msgs/msg/TFMessage` with the transforms of N poses, whose bodies' frames are `children`, in `frame`."""
    cdr = Cdr()
    cdr.u32(len(poses))
    for pose, child in zip(poses, children, strict=True):
        _put_header(cdr, pose, frame)
        cdr.text(child)
        _put_pose(cdr, pose)
    return cdr.finish()


def relative_poses(message: RelativePositions, frame: str) -> list[bytes]:
    """`geometry_msgs/msg/PoseWithCovarianceStamped` of each roundel that a camera locates, in the camera's frame.

    The z axis points out of the printed side, by the more probable normal. The rotation about it is unknown; the x
    axis is in the plane of the normal and of the camera's x axis, and the variance is that of any angle. The other
    normal adds its probability times the squared angle between both to the covariance.
    """
    seen = message.unpack()
    return [
        _relative_pose(message, frame, seen.position[k], seen.normals[k, 0], _roundel_covariance(seen, k))
        for k in range(len(seen))
    ]


def _relative_pose(
    message: RelativePositions, frame: str, position: Array, normal: Array, covariance: Array
) -> bytes:
    cdr = Cdr()
    _put_header(cdr, message, frame)
    w, x, y, z = wxyz_from_rotation(rotation_with_z(normal))
    cdr.doubles(*position, x, y, z, w)
    cdr.array(covariance)
    return cdr.finish()


def _roundel_covariance(seen: LocatedRoundels, k: int) -> Array:
    """(6, 6) covariance of position and of rotation about the camera's axes."""
    first, second = seen.normals[k]
    along = np.outer(first, first)
    axis = np.cross(first, second)
    sine = float(np.linalg.norm(axis))
    between = axis * (np.arctan2(sine, float(first @ second)) / max(sine, 1e-12))
    cov = np.zeros((6, 6))
    cov[:3, :3] = seen.cov[k]
    cov[3:, 3:] = seen.normal_sigma[k, 0] ** 2 * (np.eye(3) - along) + ANY_ANGLE * along
    cov[3:, 3:] += seen.probability[k, 1] * np.outer(between, between)
    return cov


def _put_header(cdr: Cdr, message: RobotPose | RelativePositions, frame: str) -> None:
    cdr.u32(*divmod(message.t_ns, 1_000_000_000))
    cdr.text(frame)


def _put_pose(cdr: Cdr, pose: RobotPose) -> None:
    """Put the seven numbers that a Pose and a Transform have in common."""
    w, x, y, z = pose.quaternion_wxyz
    cdr.doubles(*pose.position, x, y, z, w)
