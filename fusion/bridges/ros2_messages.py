# SPDX-License-Identifier: BSD-3-Clause
"""Encodes a robot's pose as ROS 2 messages: little-endian CDR, the bytes of rmw implementations.

The conventions are ROS's (REP 103, REP 105, the comments of `geometry_msgs`): quaternions x, y, z, w; covariances of
position, then of rotation about the frame's fixed axes; a twist in the frame of the moving body.
"""

import struct
from collections.abc import Sequence
from functools import lru_cache

import numpy as np

from camera_node.detection.roundels import LocatedRoundels
from camera_node.foundation.arrays import Array
from camera_node.geometry.pose import rotation_with_z, wxyz_from_rotation
from camera_node.protocol.messages import RelativePositions
from fusion.bridges.body_motion import covariances, rotations, twists
from fusion.protocol.pose_messages import RobotPose

ENCAPSULATION = b"\0\1\0\0"  # of little-endian CDR
STAMP, LENGTH, SEVEN = struct.Struct("<II"), struct.Struct("<I"), struct.Struct("<7d")
ANY_ANGLE = np.pi**2 / 3  # variance of an angle of which nothing is known, square radians


def pose_stamped(pose: RobotPose, frame: str) -> bytes:
    """`geometry_msgs/msg/PoseStamped` in the frame named `frame`, which is the arena's world."""
    return ENCAPSULATION + _header(pose.t_ns, _texts(STAMP.size, frame)) + _numbers(pose)


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
    rows = [C[:, :6, :6].reshape(-1, 36), twist.reshape(-1, 6), C[:, 6:, 6:].reshape(-1, 36)]
    behind_pose = np.concatenate(rows, axis=1).astype("<f8")
    return [
        ENCAPSULATION + _header(pose.t_ns, _texts(STAMP.size, frame, child)) + _numbers(pose) + row.tobytes()
        for pose, child, row in zip(poses, children, behind_pose, strict=True)
    ]


def transforms(poses: Sequence[RobotPose], frame: str, children: Sequence[str]) -> bytes:
    """`tf2_msgs/msg/TFMessage` with the transforms of N poses, whose bodies' frames are `children`, in `frame`."""
    parts = [ENCAPSULATION, LENGTH.pack(len(poses))]
    offset = LENGTH.size  # of the next transform, modulo 8
    for pose, child in zip(poses, children, strict=True):
        parts += [_header(pose.t_ns, _texts(offset + STAMP.size, frame, child)), _numbers(pose)]
        offset = 0
    return b"".join(parts)


def named_poses(poses: Sequence[RobotPose], frame: str) -> bytes:
    """`motion_capture_tracking_interfaces/msg/NamedPoseArray` of poses of one instant."""
    return _bodies(poses, frame, b"", b"")


def rigid_bodies(poses: Sequence[RobotPose], frame: str, number: int) -> bytes:
    """`mocap4r2_msgs/msg/RigidBodies` of poses of one instant, numbered; without the bodies' markers."""
    return _bodies(poses, frame, LENGTH.pack(number % 2**32), LENGTH.pack(0))


def _bodies(poses: Sequence[RobotPose], frame: str, behind_header: bytes, behind_name: bytes) -> bytes:
    """A header and a sequence of names with poses; numbers of four bytes may stand between them."""
    data = bytearray(STAMP.pack(*divmod(poses[0].t_ns, 1_000_000_000)))
    _append_text(data, frame)
    data += behind_header + LENGTH.pack(len(poses))
    for pose in poses:
        _append_text(data, pose.robot)
        data += behind_name
        data += bytes(-len(data) % 8) + _numbers(pose)
    return ENCAPSULATION + bytes(data)


def _append_text(data: bytearray, text: str) -> None:
    """Append a string, and the padding in front of a number of four bytes."""
    encoded = text.encode() + b"\0"
    data += LENGTH.pack(len(encoded)) + encoded
    data += bytes(-len(data) % LENGTH.size)


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
    w, x, y, z = wxyz_from_rotation(rotation_with_z(normal))
    numbers = np.concatenate([position, [x, y, z, w], covariance.ravel()]).astype("<f8")
    return ENCAPSULATION + _header(message.t_ns, _texts(STAMP.size, frame)) + numbers.tobytes()


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


@lru_cache(maxsize=8192)
def _texts(offset: int, *texts: str) -> bytes:
    """Strings that begin at `offset`, and the padding in front of the doubles that follow.

    The offset of each number behind the encapsulation is a multiple of its size.
    """
    data = bytearray(offset)
    for text in texts:
        _append_text(data, text)
    return bytes(data[offset:]) + bytes(-len(data) % 8)


def _header(t_ns: int, texts: bytes) -> bytes:
    return STAMP.pack(*divmod(t_ns, 1_000_000_000)) + texts


def _numbers(pose: RobotPose) -> bytes:
    """The seven numbers that a Pose and a Transform have in common."""
    w, x, y, z = pose.quaternion_wxyz
    return SEVEN.pack(*pose.position, x, y, z, w)
