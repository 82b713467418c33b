# SPDX-License-Identifier: BSD-3-Clause
"""Distributes the robots of an arena over several fusion processes (shards), by their names.

Every shard receives all detections and knows all robots. It estimates and publishes its own robots, and takes the poses
of the others from their shards, so that no detection is assigned to two robots. The first shard leads: it is the router
and the clock, owns the rig, and publishes the markers.
"""

import zlib
from dataclasses import dataclass

import numpy as np

from camera_node.foundation.arrays import Index
from camera_node.foundation.errors import ConfigError
from camera_node.geometry.pose import rotation_from_vector, rotation_from_wxyz, wxyz_from_rotation
from fusion.model.states import States
from fusion.protocol.pose_messages import ShardPoses, TrackingState


@dataclass(frozen=True)
class Shard:
    """Shard `index` of `count`, counted from 1."""

    index: int = 1
    count: int = 1

    @classmethod
    def parse(cls, text: str) -> "Shard":
        """Parse text such as `2/3`, the second of three.

        Raises:
            ConfigError: the text is no shard.
        """
        index, _, count = text.partition("/")
        if not (index.isdecimal() and count.isdecimal() and 1 <= int(index) <= int(count) <= 64):
            raise ConfigError(f"--shard {text}: write it as 1/2, the first of two; 64 at the most")
        return cls(int(index), int(count))

    @property
    def leads(self) -> bool:
        return self.index == 1

    def owns(self, robot: str) -> bool:
        """Whether this shard estimates the robot. Only the robot's name decides, so other robots can't change it."""
        return zlib.crc32(robot.encode()) % self.count == self.index - 1


def shard_poses_of(
    names: tuple[str, ...], t_ns: int, states: States, status: list[TrackingState | None], rows: Index
) -> ShardPoses:
    """The message of a shard for the others.

    Args:
        names: of all N robots.
        t_ns: the time of the states.
        states: of all N robots.
        status: of all N robots; not None for those in `rows`.
        rows: the robots to publish.
    """
    selected = states.select(rows)
    motion = np.column_stack([selected.p, wxyz_from_rotation(selected.R), selected.v, selected.omega])
    return ShardPoses(
        t_ns=t_ns,
        robots=tuple(names[k] for k in rows.tolist()),
        states=tuple(state for k in rows.tolist() if (state := status[k]) is not None),
        motion=motion.astype("<f8").tobytes(),
        covariance=selected.P.astype("<f4").tobytes(),
    )


def states_of(poses: ShardPoses, t_ns: int) -> States:
    """The states of another shard's robots, predicted to `t_ns` with constant velocities."""
    dt = (t_ns - poses.t_ns) * 1e-9
    p, wxyz, v, omega = np.split(poses.motions(), [3, 7, 10], axis=1)
    return States(
        rotation_from_vector(omega * dt) @ rotation_from_wxyz(wxyz), p + v * dt, omega, v, poses.covariances()
    )
