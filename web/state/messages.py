# SPDX-License-Identifier: BSD-3-Clause
"""The Zenoh message of the demo: its progress and the true positions of what it simulates."""

import msgspec

from camera_node.geometry.pose import Pose
from camera_node.protocol.messages import VERSION, MessageError
from fusion.protocol.pose_messages import MAX_NUMBER

Vector = tuple[float, float, float]


class DemoProgress(msgspec.Struct, frozen=True, kw_only=True):
    """A status line, the completed share of the current step, true marker positions and poses of moving cameras.

    `true_points` maps the name of a simulated object to its marker positions in the world, metres, and `true_cameras`
    the name of a camera that moves, which no rig can have, to its pose in the world. The viewer draws them. The
    encoding is that of `camera_node.protocol.messages`.
    """

    version: int = VERSION
    t_ns: int
    text: str
    share: float  # completed part of the current step, 0 to 1
    true_points: dict[str, tuple[Vector, ...]] = {}
    true_cameras: dict[str, Pose] = {}

    def check(self) -> None:
        """Raise MessageError unless `share` is within 0 to 1 and all coordinates are in range."""
        places = [point for points in self.true_points.values() for point in points]
        places += [pose.position_m for pose in self.true_cameras.values()]
        if not (0.0 <= self.share <= 1.0 and all(abs(x) <= MAX_NUMBER for place in places for x in place)):
            raise MessageError("a share outside 0 to 1, or a true position out of range")


def progress_key(arena: str) -> str:
    """The Zenoh key of `DemoProgress`."""
    return f"{arena}/demo/progress"
