# SPDX-License-Identifier: BSD-3-Clause
"""Robots shared out over several fusion processes of one arena, by their names.

Every shard hears all detections and knows all robots. It estimates and publishes its own; the others' it takes from
what their shards tell of them, so that their detections are claimed, and none is of two robots. The first shard leads:
it holds the router, the clock and the rig, and publishes the markers.
"""

import zlib
from dataclasses import dataclass

import numpy as np

from camera_node.arrays import Index
from camera_node.errors import ConfigError
from camera_node.geometry.pose import rotation_from_vector, rotation_from_wxyz, wxyz_from_rotation
from fusion.model.states import States
from fusion.protocol.messages import ShardPoses, TrackingState


@dataclass(frozen=True)
class Shard:
    """Shard `index` of `count`, counted from 1."""

    index: int = 1
    count: int = 1

    @classmethod
    def parse(cls, text: str) -> "Shard":
        """`2/3` is the second of three.

        Raises:
            ConfigError: it is none.
        """
        index, _, count = text.partition("/")
        if not (index.isdecimal() and count.isdecimal() and 1 <= int(index) <= int(count) <= 64):
            raise ConfigError(f"--shard {text}: write it as 1/2, the first of two; 64 at the most")
        return cls(int(index), int(count))

    @property
    def leads(self) -> bool:
        return self.index == 1

    def owns(self, robot: str) -> bool:
        """Whether this shard estimates the robot: by its name alone, so that other robots don't change it."""
        return zlib.crc32(robot.encode()) % self.count == self.index - 1


def told_of(
    names: tuple[str, ...], t_ns: int, states: States, status: list[TrackingState | None], rows: Index
) -> ShardPoses:
    """What a shard tells the others of robots `rows`, each of which has a status."""
    of_each = states.select(rows)
    motion = np.column_stack([of_each.p, wxyz_from_rotation(of_each.R), of_each.v, of_each.omega])
    return ShardPoses(
        t_ns=t_ns,
        robots=tuple(names[k] for k in rows.tolist()),
        states=tuple(state for k in rows.tolist() if (state := status[k]) is not None),
        motion=motion.astype("<f8").tobytes(),
        covariance=of_each.P.astype("<f4").tobytes(),
    )


def states_of(told: ShardPoses, t_ns: int) -> States:
    """The robots that another shard told of, carried to `t_ns` by their speeds."""
    dt = (t_ns - told.t_ns) * 1e-9
    p, wxyz, v, omega = np.split(told.motions(), [3, 7, 10], axis=1)
    return States(
        rotation_from_vector(omega * dt) @ rotation_from_wxyz(wxyz), p + v * dt, omega, v, told.covariances()
    )
