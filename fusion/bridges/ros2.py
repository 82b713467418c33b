# SPDX-License-Identifier: BSD-3-Clause
"""`fusion ros2`: an arena's robots as topics of ROS 2, whose nodes run with RMW_IMPLEMENTATION=rmw_zenoh_cpp.

Needs no ROS here: what rmw_zenoh_cpp puts on Zenoh (its docs/design.md) is put there by this program. A topic is a key
of domain, name, type and the type's hash; a liveliness token of the same shows it to `ros2 topic list`.
"""

import contextlib
import hashlib
import logging
import os
import queue
import re
import struct
import time
from collections import Counter
from pathlib import Path
from typing import Annotated

import tyro
import zenoh

from camera_node.errors import ConfigError
from camera_node.protocol.session import open_client
from fusion.bridges.ros2_messages import TYPE_HASHES, odometry, pose_stamped, transform
from fusion.client.arena import Arena
from fusion.protocol.messages import RobotPose

log = logging.getLogger("fusion.ros2")
NODE = "roundel"
NO_HASH = "TypeHashNotSupported"  # what ROS 2 Humble, which has no hashes, writes in their place
QOS = "::,10:,:,:,,"  # reliable, volatile, the last ten: all else as rmw_zenoh has it by default
QUEUE = 2000
SILENCE_S = 5.0
MAX_DOMAIN = 232


class Ros2Node:
    """A ROS 2 node in a Zenoh session: its publishers, and the tokens that show them. `faults` counts."""

    def __init__(
        self, session: zenoh.Session, domain: int = 0, namespace: str = "", humble: bool = False
    ) -> None:
        self.faults: Counter[str] = Counter()
        self._session, self._domain, self._humble = session, domain, humble
        self._namespace = namespace
        self._topics: dict[str, Ros2Topic] = {}
        self._robots: dict[str, str] = {}  # ROS's name -> ours
        self._token = session.liveliness().declare_token(self._entity(0, "NN"))

    def publish(self, pose: RobotPose, frame: str) -> None:
        """`<robot>/pose`, `<robot>/odometry` and `tf`; nothing of a robot that is lost."""
        name = ros_name(pose.robot)
        if self._robots.setdefault(name, pose.robot) != pose.robot:
            self.faults[
                f"poses of '{pose.robot}', whose name ROS can't tell from '{self._robots[name]}'"
            ] += 1
        elif pose.state != "lost":
            own = f"{self._namespace}/{name}".lstrip("/")
            self._topic(f"{own}/pose", "geometry_msgs/msg/PoseStamped").put(pose_stamped(pose, frame))
            self._topic(f"{own}/odometry", "nav_msgs/msg/Odometry").put(odometry(pose, frame, name))
            self._topic("tf", "tf2_msgs/msg/TFMessage").put(transform(pose, frame, name))

    def _topic(self, name: str, kind: str) -> "Ros2Topic":
        if name not in self._topics:
            log.info("publishes /%s, %s", name, kind)
            package, _, message = kind.split("/")
            dds = f"{package}::msg::dds_::{message}_"
            typed = f"{dds}/{NO_HASH if self._humble else 'RIHS01_' + TYPE_HASHES[kind]}"
            entity = f"{self._entity(len(self._topics) + 1, 'MP')}/%{name.replace('/', '%')}/{typed}/{QOS}"
            self._topics[name] = Ros2Topic(self._session, f"{self._domain}/{name}/{typed}", entity)
        return self._topics[name]

    def _entity(self, number: int, kind: str) -> str:
        """The part of a token that all of this node's have; slashes in names are %."""
        where = f"@ros2_lv/{self._domain}/{self._session.info.zid()}/0/{number}/{kind}"
        return f"{where}/%/%{self._namespace.replace('/', '%')}/{NODE}"


class Ros2Topic:
    """A publisher as rmw_zenoh_cpp has them: each message comes with its number, its time and who sent it."""

    def __init__(self, session: zenoh.Session, key: str, entity: str) -> None:
        self._publisher = session.declare_publisher(key)
        self._token = session.liveliness().declare_token(entity)
        self._gid = hashlib.blake2b(entity.encode(), digest_size=16).digest()
        self._count = 0

    def put(self, data: bytes) -> None:
        self._count += 1
        sender = struct.pack("<qqB16s", self._count, time.time_ns(), len(self._gid), self._gid)
        self._publisher.put(data, attachment=sender)


def ros_name(robot: str) -> str:
    """The robot's name with what ROS allows in one: letters, digits and underscores, no digit first."""
    name = re.sub(r"[^A-Za-z0-9_]", "_", robot)
    return f"robot_{name}" if name[:1].isdigit() else name


def ros2(
    *,
    connect: tuple[str, ...] = ("tcp/127.0.0.1:7447",),
    arena: str = "arena",
    zenoh_config: Annotated[Path | None, tyro.conf.arg(name="zenoh")] = None,
    ros: tuple[str, ...] | None = None,
    domain: int | None = None,
    namespace: str = "",
    frame: str = "world",
    humble: bool = False,
) -> int:
    """Publish an arena's robots to ROS 2, for nodes that run with RMW_IMPLEMENTATION=rmw_zenoh_cpp, until stopped.

    Args:
        connect: the server's Zenoh endpoints.
        arena: the arena's name.
        zenoh_config: a Zenoh configuration (JSON5) for TLS, access control or scouting.
        ros: endpoints of ROS 2's own Zenoh router (rmw_zenohd), where the server's is not the one that nodes use.
        domain: ROS 2's domain; that of ROS_DOMAIN_ID, or 0, unless given.
        namespace: what stands before the robots' topics, such as lab1.
        frame: the name that the world has in headers and in tf.
        humble: nodes are of ROS 2 Humble, whose topics carry no type hash.
    """
    domain, namespace = _domain(domain), _namespace(namespace)
    arrived: queue.Queue[RobotPose] = queue.Queue(QUEUE)
    with contextlib.ExitStack() as stack:
        client = stack.enter_context(Arena.connect(*connect, arena=arena, zenoh_config=zenoh_config))
        session = stack.enter_context(open_client(ros or connect, None if ros else zenoh_config))
        node = Ros2Node(session, domain, namespace, humble)
        stack.callback(_tell, node.faults, client.faults)
        stack.callback(client.poses().on_message(lambda pose: _enqueue(arrived, pose, node.faults)))
        with contextlib.suppress(KeyboardInterrupt):
            _pass_on(arrived, node, frame, f"arena '{arena}' at {' '.join(connect)}")
    return 0


def _domain(given: int | None) -> int:
    text = os.environ.get("ROS_DOMAIN_ID", "0") if given is None else str(given)
    if not (text.isdecimal() and int(text) <= MAX_DOMAIN):
        raise ConfigError(
            f"the ROS domain is '{text}'; give --domain, or ROS_DOMAIN_ID, from 0 to {MAX_DOMAIN}"
        )
    return int(text)


def _namespace(given: str) -> str:
    name = given.strip("/")
    if name and not all(part and ros_name(part) == part for part in name.split("/")):
        raise ConfigError(
            f"'{given}' is no namespace of ROS; give --namespace letters, digits and underscores"
        )
    return name


def _enqueue(arrived: queue.Queue[RobotPose], pose: RobotPose, faults: Counter[str]) -> None:
    try:
        arrived.put_nowait(pose)
    except queue.Full:
        faults["poses dropped, which came faster than they could be passed on"] += 1


def _pass_on(arrived: queue.Queue[RobotPose], node: Ros2Node, frame: str, whence: str) -> None:
    silent = False
    while True:
        try:
            pose = arrived.get(timeout=SILENCE_S)
        except queue.Empty:
            if not silent:
                log.warning("no pose from %s for %g s; is python -m fusion running there?", whence, SILENCE_S)
            silent = True
            continue
        if silent:
            log.info("there are poses again")
        silent = False
        node.publish(pose, frame)


def _tell(*faults: Counter[str]) -> None:
    for what, count in sum(faults, Counter[str]()).items():
        log.warning("%d %s", count, what)
