# SPDX-License-Identifier: BSD-3-Clause
"""The poses of a recording, read one after the other: an hour of a large arena exceeds the memory."""

from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path

from calib.rig.camera import Camera
from calib.rig.recording import read_decoded
from calib.rig.rig_messages import RigMessage
from camera_node.foundation.errors import ConfigError
from fusion.model.robots import Robot
from fusion.protocol.pose_messages import RobotPose, Robots

MM = 1000.0  # in a metre
KINDS = {"/robots": Robots, "/rig": RigMessage, "/pose": RobotPose}


class RecordedPoses:
    """The poses of a recording; iterating reads the file.

    Args:
        path: the MCAP file.
        robots: names of the robots to read; all unless given.

    Attributes:
        bodies: the robots' markers that were recorded last before the present pose.
        cameras: the cameras of the rig that was recorded last before it.
        counts: poses by robot.
        faults: skipped messages, by reason.
    """

    def __init__(self, path: Path, robots: Sequence[str] = ()) -> None:
        self.path = path
        self.bodies: dict[str, Robot] = {}
        self.cameras: dict[str, Camera] = {}
        self.counts: Counter[str] = Counter()
        self.faults: Counter[str] = Counter()
        self._robots = frozenset(robots)

    def __iter__(self) -> Iterator[RobotPose]:
        """Yield the poses of each robot in the order of their times.

        Raises:
            ConfigError: the file is missing or no recording, or holds no poses of these robots.
        """
        self.counts.clear()
        last_ns: dict[str, int] = {}
        for _, message in read_decoded(self.path, KINDS, self.faults, {"/pose": "undecodable poses"}):
            if isinstance(message, Robots):
                self.bodies = message.robots
            elif isinstance(message, RigMessage):
                self.cameras = message.rig.cameras
            elif not self._robots or message.robot in self._robots:
                if message.t_ns <= last_ns.get(message.robot, -1):
                    self.faults["poses that are not later than the one before"] += 1
                    continue
                last_ns[message.robot] = message.t_ns
                self.counts[message.robot] += 1
                yield message
        self._check()

    def _check(self) -> None:
        if not self.counts and not self._robots:
            rig = "" if self.cameras else " --rig rig.yaml"
            robots = "" if self.bodies else " --robots robots.yaml"
            raise ConfigError(
                f"{self.path} holds no poses; write them with "
                f"roundel replay {self.path}{rig}{robots} --out fused.mcap"
            )
        if missing := sorted(self._robots - set(self.counts)):
            raise ConfigError(f"{self.path} holds no poses of {', '.join(missing)}; check --robots")
