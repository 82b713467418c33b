# SPDX-License-Identifier: BSD-3-Clause
"""Publishes the server's results on the arena's keys."""

from collections.abc import Iterable

import msgspec

from calib.rig.messages import RigMessage
from camera_node.protocol.messages import Keys, encode
from camera_node.protocol.registration import CameraAssignment, assigned_key
from fusion.model.frames import FrameSet
from fusion.protocol.pose_messages import (
    FusedFrames,
    FusionStatus,
    Latency,
    Markers,
    RobotPose,
    RobotPoses,
    ShardPoses,
    frames_key,
    shard_key,
)
from fusion.protocol.shards import Shard
from fusion.server.transport import Transport


class ArenaPublisher:
    """Publishes poses, markers, the rig and the status of one shard; only the leading shard publishes markers.

    Args:
        transport: the server's.
        keys: the arena's.
        shard: of this process.
    """

    def __init__(self, transport: Transport, keys: Keys, shard: Shard) -> None:
        self._transport, self._keys, self._shard = transport, keys, shard
        self._shard_key = shard_key(keys.arena, shard.index)
        self._status_key = keys.fusion_status + ("" if shard.leads else f"/{shard.index}")

    def publish_poses(self, poses: Iterable[RobotPose], latency: Latency | None) -> None:
        """Publish poses, each with the latency of its frame set: all in one message, and each on its robot's key."""
        encoded = {pose.robot: encode(msgspec.structs.replace(pose, latency=latency)) for pose in poses}
        if encoded:
            self._transport.put(self._keys.poses, RobotPoses.join(tuple(encoded.values())))
        for robot, data in encoded.items():
            self._transport.put(self._keys.robot_pose(robot), data)

    def publish_shard(self, poses: ShardPoses) -> None:
        """Publish this shard's robots for the other shards."""
        self._transport.publish(self._shard_key, poses)

    def publish_frames(self, frame_set: FrameSet) -> None:
        """Publish which frames were fused in a frame set."""
        if self._shard.leads:
            self._transport.publish(frames_key(self._keys.arena), FusedFrames.of(frame_set))

    def publish_markers(self, markers: Markers) -> None:
        """Publish all markers of a frame set."""
        if self._shard.leads:
            self._transport.publish(self._keys.markers, markers)

    def publish_rig(self, rig: RigMessage) -> None:
        """Publish a corrected rig."""
        self._transport.publish(self._keys.rig, rig)

    def publish_assignment(self, assignment: CameraAssignment) -> None:
        """Send a camera its new name and settings."""
        key = assigned_key(self._keys.arena, assignment.id)
        self._transport.publish(key, assignment)
        self._transport.undeclare(key)

    def publish_status(self, status: FusionStatus) -> None:
        """Publish this shard's status."""
        self._transport.publish(self._status_key, status)

    def stop_robots(self, names: Iterable[str]) -> None:
        """Undeclare the publishers of robots that no longer exist."""
        for name in names:
            self._transport.undeclare(self._keys.robot_pose(name))
