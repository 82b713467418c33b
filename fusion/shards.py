# SPDX-License-Identifier: BSD-3-Clause
"""Robots shared out over several fusion processes of one arena, by their names.

Every shard hears all detections and knows all robots. It estimates and publishes its own; the others' it takes from
their shards' poses, so that their detections are claimed, and none is of two robots. The first shard leads: it holds
the router, the clock and the rig, and publishes the markers.
"""

import zlib
from dataclasses import dataclass

from camera_node.errors import ConfigError


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
