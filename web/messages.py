# SPDX-License-Identifier: BSD-3-Clause
"""The demo's message over Zenoh, encoded as in `camera_node.protocol.messages`: its progress, and the true poses."""

import math

import msgspec

from camera_node.protocol.messages import VERSION, MessageError

Vector = tuple[float, float, float]


class DemoProgress(msgspec.Struct, frozen=True, kw_only=True):
    """A line for people, how much of the step is done, and where the simulation knows things to be.

    `ghosts` maps a name to points in the world, metres, joined by a line in the viewer.
    """

    version: int = VERSION
    t_ns: int
    text: str
    share: float  # of the present step, 0 to 1
    ghosts: dict[str, tuple[Vector, ...]] = {}

    def check(self) -> None:
        """Raise MessageError unless all numbers are finite and the share is one."""
        points = (x for ghost in self.ghosts.values() for point in ghost for x in point)
        if not (0.0 <= self.share <= 1.0 and all(map(math.isfinite, points))):
            raise MessageError("a share outside 0 to 1, or a ghost that is not finite")


def progress_key(arena: str) -> str:
    """The Zenoh key of `DemoProgress`."""
    return f"{arena}/demo/progress"
