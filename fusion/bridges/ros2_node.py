# SPDX-License-Identifier: BSD-3-Clause
"""Publishes an arena's robots as topics of ROS 2. This needs no ROS: `ros2_zenoh.py` and `ros2_dds.py` send the bytes
that the implementations of ROS's middleware send."""

import logging
import re
import threading
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import groupby
from typing import Literal, Protocol

from camera_node.foundation.errors import ConfigError
from camera_node.foundation.logs import about
from camera_node.protocol.messages import RelativePositions
from fusion.bridges.ros2_messages import (
    named_poses,
    odometries,
    pose_stamped,
    relative_poses,
    rigid_bodies,
    transforms,
)
from fusion.bridges.ros2_types import (
    NAMED_POSES,
    ODOMETRY,
    POSE_STAMPED,
    POSE_WITH_COVARIANCE_STAMPED,
    RIGID_BODIES,
    TRANSFORMS,
)
from fusion.protocol.pose_messages import RobotPose

log = logging.getLogger("fusion.ros2")
MAX_DOMAIN = 232
NOT_PERMITTED = re.compile(r"[^A-Za-z0-9_]")
MessageSet = Literal["crazyswarm2", "mocap4r2"]


class Ros2Topic(Protocol):
    """A publisher of encoded messages."""

    def put(self, data: bytes, is_last: bool) -> bool:
        """Send a message; if it `is_last` of a burst, without waiting for more. Whether no reader held it up."""
        ...


class Ros2Middleware(Protocol):
    """What carries topics: Zenoh or DDS."""

    def declare(self, name: str, kind: str) -> Ros2Topic:
        """A publisher of messages of a kind, such as `nav_msgs/msg/Odometry`, on a topic without a leading slash."""
        ...


class Ros2Node:
    """The topics of an arena's robots. `faults` counts skipped poses and messages.

    Args:
        middleware: declares the publishers.
        namespace: prefix of the topics, without slashes at its ends.
        sets: sets of messages beside the usual ones: `poses` of Crazyswarm2, `rigid_bodies` of mocap4r2.
    """

    def __init__(
        self, middleware: Ros2Middleware, namespace: str = "", sets: Sequence[MessageSet] = ()
    ) -> None:
        self.faults: Counter[str] = Counter()
        self._middleware, self._namespace, self._sets = middleware, namespace, frozenset(sets)
        self._topics: dict[str, Ros2Topic] = {}
        self._lock = threading.Lock()  # of the topics: positions arrive in Zenoh's threads
        self._robots: dict[str, RobotTopics] = {}  # by name in the arena
        self._n_instants = 0

    def publish(self, poses: Sequence[RobotPose], frame: str) -> None:
        """Publish `<robot>/pose`, `<robot>/odometry` of the robots that are not lost, and all of them in one `tf`."""
        shown = [pose for pose in poses if pose.state != "lost" and self._has_topics(pose.robot)]
        if not shown:
            return
        robots = [self._robots[pose.robot] for pose in shown]
        names = [robot.name for robot in robots]
        self._send([robot.odometry for robot in robots], odometries(shown, frame, names))
        self._send([robot.pose for robot in robots], [pose_stamped(pose, frame) for pose in shown])
        self._send([self._topic("tf", TRANSFORMS)], [transforms(shown, frame, names)])
        if self._sets:
            for _, instant in groupby(shown, lambda pose: pose.t_ns):
                self._publish_sets(list(instant), frame)

    def _publish_sets(self, poses: Sequence[RobotPose], frame: str) -> None:
        """Publish the robots of one instant together, by their names in the arena."""
        self._n_instants += 1
        if "crazyswarm2" in self._sets:
            self._send([self._topic(self._named("poses"), NAMED_POSES)], [named_poses(poses, frame)])
        if "mocap4r2" in self._sets:
            message = rigid_bodies(poses, frame, self._n_instants)
            self._send([self._topic(self._named("rigid_bodies"), RIGID_BODIES)], [message])

    def publish_relative(self, message: RelativePositions) -> None:
        """Publish `<camera>/relative`: one message for each roundel that the camera locates, in its optical frame."""
        name = ros_name(message.camera)
        topic = self._topic(self._named(f"{name}/relative"), POSE_WITH_COVARIANCE_STAMPED)
        messages = relative_poses(message, f"{name}_optical_frame")
        self._send([topic] * len(messages), messages)

    def _named(self, topic: str) -> str:
        return f"{self._namespace}/{topic}".lstrip("/")

    def _has_topics(self, robot: str) -> bool:
        """Whether the robot has topics or gets them now; if another one has its name in ROS, its poses are counted."""
        if robot in self._robots:
            return True
        name = ros_name(robot)
        first = next((other for other, topics in self._robots.items() if topics.name == name), None)
        if first is not None:
            self.faults[f"poses of '{robot}', which has the same ROS name as '{first}'"] += 1
            return False
        self._robots[robot] = RobotTopics(
            name,
            self._topic(self._named(f"{name}/pose"), POSE_STAMPED),
            self._topic(self._named(f"{name}/odometry"), ODOMETRY),
        )
        return True

    def _topic(self, name: str, kind: str) -> Ros2Topic:
        with self._lock:
            if name not in self._topics:
                log.info("publishes /%s, %s", name, kind, extra=about(name))
                self._topics[name] = self._middleware.declare(name, kind)
            return self._topics[name]

    def _send(self, topics: Sequence[Ros2Topic], messages: Sequence[bytes]) -> None:
        """Put one message on each topic, as a burst."""
        for number, (topic, message) in enumerate(zip(topics, messages, strict=True), 1):
            if not topic.put(message, is_last=number == len(topics)):
                self.faults["messages that a slow reader held up"] += 1


@dataclass(frozen=True, slots=True)
class RobotTopics:
    """A robot's name in ROS and its topics."""

    name: str
    pose: Ros2Topic
    odometry: Ros2Topic


def ros_name(robot: str) -> str:
    """The robot's name with the characters that ROS permits: letters, digits and underscores, no digit first."""
    name = NOT_PERMITTED.sub("_", robot)
    return f"robot_{name}" if name[:1].isdigit() else name


def parse_domain(text: str) -> int:
    """A ROS domain.

    Raises:
        ConfigError: the text is no number from 0 to 232.
    """
    if not (text.isdecimal() and int(text) <= MAX_DOMAIN):
        raise ConfigError(
            f"the ROS domain is '{text}'; give --domain, or ROS_DOMAIN_ID, from 0 to {MAX_DOMAIN}"
        )
    return int(text)


def parse_namespace(text: str) -> str:
    """A ROS namespace, without slashes at its ends.

    Raises:
        ConfigError: a part of it is no ROS name.
    """
    name = text.strip("/")
    if name and not all(part and ros_name(part) == part for part in name.split("/")):
        raise ConfigError(f"'{text}' is no ROS namespace; give --namespace letters, digits and underscores")
    return name
