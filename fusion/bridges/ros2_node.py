# SPDX-License-Identifier: BSD-3-Clause
"""Publishes an arena's robots as topics of ROS 2, for nodes that run with RMW_IMPLEMENTATION=rmw_zenoh_cpp.

This needs no ROS: it puts the same bytes on the same Zenoh keys as rmw_zenoh_cpp (its docs/design.md). The key of a
topic consists of domain, name, type and the type's hash; a liveliness token of the same shows it to `ros2 topic list`.
"""

import hashlib
import logging
import re
import struct
import threading
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import zenoh

from camera_node.foundation.errors import ConfigError
from camera_node.foundation.logs import about
from camera_node.protocol.messages import RelativePositions
from fusion.bridges.ros2_messages import TYPE_HASHES, odometries, pose_stamped, relative_poses, transforms
from fusion.protocol.pose_messages import RobotPose

log = logging.getLogger("fusion.ros2")
NODE = "roundel"
RELATIVE = "geometry_msgs/msg/PoseWithCovarianceStamped"
NO_HASH = "TypeHashNotSupported"  # in place of the hash in ROS 2 Humble, which has none
QOS = "::,10:,:,:,,"  # reliable, volatile, the last ten; everything else is rmw_zenoh's default
MAX_DOMAIN = 232
NOT_PERMITTED = re.compile(r"[^A-Za-z0-9_]")


class Ros2Node:
    """A ROS 2 node in a Zenoh session: its publishers and their liveliness tokens. `faults` counts skipped poses.

    Args:
        session: an open Zenoh session.
        domain: ROS 2's domain.
        namespace: prefix of the topics, without slashes at its ends.
        humble: whether the nodes are of ROS 2 Humble, whose topics have no type hash.
    """

    def __init__(
        self, session: zenoh.Session, domain: int = 0, namespace: str = "", humble: bool = False
    ) -> None:
        self.faults: Counter[str] = Counter()
        self._session, self._domain, self._humble = session, domain, humble
        self._namespace = namespace
        self._topics: dict[str, Ros2Topic] = {}
        self._lock = threading.Lock()  # of the topics: positions arrive in Zenoh's threads
        self._robots: dict[str, RobotTopics] = {}  # by name in the arena
        self._token = session.liveliness().declare_token(self._entity(0, "NN"))

    def publish(self, poses: Sequence[RobotPose], frame: str) -> None:
        """Publish `<robot>/pose`, `<robot>/odometry` of the robots that are not lost, and all of them in one `tf`."""
        shown = [pose for pose in poses if pose.state != "lost" and self._has_topics(pose.robot)]
        if not shown:
            return
        robots = [self._robots[pose.robot] for pose in shown]
        names = [robot.name for robot in robots]
        _send([robot.odometry for robot in robots], odometries(shown, frame, names))
        _send([robot.pose for robot in robots], [pose_stamped(pose, frame) for pose in shown])
        _send([self._topic("tf", "tf2_msgs/msg/TFMessage")], [transforms(shown, frame, names)])

    def publish_relative(self, message: RelativePositions) -> None:
        """Publish `<camera>/relative`: one message for each roundel that the camera locates, in its optical frame."""
        name = ros_name(message.camera)
        topic = self._topic(f"{self._namespace}/{name}/relative".lstrip("/"), RELATIVE)
        messages = relative_poses(message, f"{name}_optical_frame")
        _send([topic] * len(messages), messages)

    def _has_topics(self, robot: str) -> bool:
        """Whether the robot has topics or gets them now; if another one has its name in ROS, its poses are counted."""
        if robot in self._robots:
            return True
        name = ros_name(robot)
        first = next((other for other, topics in self._robots.items() if topics.name == name), None)
        if first is not None:
            self.faults[f"poses of '{robot}', which has the same ROS name as '{first}'"] += 1
            return False
        prefix = f"{self._namespace}/{name}".lstrip("/")
        self._robots[robot] = RobotTopics(
            name,
            self._topic(f"{prefix}/pose", "geometry_msgs/msg/PoseStamped"),
            self._topic(f"{prefix}/odometry", "nav_msgs/msg/Odometry"),
        )
        return True

    def _topic(self, name: str, kind: str) -> "Ros2Topic":
        with self._lock:
            return self._declared(name, kind)

    def _declared(self, name: str, kind: str) -> "Ros2Topic":
        if name not in self._topics:
            log.info("publishes /%s, %s", name, kind, extra=about(name))
            package, _, message = kind.split("/")
            dds = f"{package}::msg::dds_::{message}_"
            typed = f"{dds}/{NO_HASH if self._humble else 'RIHS01_' + TYPE_HASHES[kind]}"
            entity = f"{self._entity(len(self._topics) + 1, 'MP')}/%{name.replace('/', '%')}/{typed}/{QOS}"
            self._topics[name] = Ros2Topic(self._session, f"{self._domain}/{name}/{typed}", entity)
        return self._topics[name]

    def _entity(self, number: int, kind: str) -> str:
        """The common part of this node's tokens; slashes in names are replaced by %."""
        node = f"@ros2_lv/{self._domain}/{self._session.info.zid()}/0/{number}/{kind}"
        return f"{node}/%/%{self._namespace.replace('/', '%')}/{NODE}"


class Ros2Topic:
    """A publisher as in rmw_zenoh_cpp: the attachment of each message has its number, its time and the sender's id."""

    def __init__(self, session: zenoh.Session, key: str, entity: str) -> None:
        self._session, self._key = session, key
        self._publisher = session.declare_publisher(key)
        self._token = session.liveliness().declare_token(entity)
        self._gid = hashlib.blake2b(entity.encode(), digest_size=16).digest()
        self._count = 0

    @cached_property
    def _express(self) -> zenoh.Publisher:
        return self._session.declare_publisher(self._key, express=True)

    def put(self, data: bytes, is_last: bool) -> None:
        """Send a message; if it `is_last` of a burst, without waiting for more."""
        self._count += 1
        attachment = struct.pack("<qqB16s", self._count, time.time_ns(), len(self._gid), self._gid)
        (self._express if is_last else self._publisher).put(data, attachment=attachment)


def _send(topics: Sequence[Ros2Topic], messages: Sequence[bytes]) -> None:
    """Put one message on each topic, as a burst.

    Zenoh waits one or more milliseconds for further messages of a burst, here and in each router, until one of them is
    express: then it sends all that it has.
    """
    for number, (topic, message) in enumerate(zip(topics, messages, strict=True), 1):
        topic.put(message, is_last=number == len(topics))


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
