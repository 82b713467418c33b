# SPDX-License-Identifier: BSD-3-Clause
"""`fusion ros2`: an arena's robots as topics of ROS 2."""

import contextlib
import logging
import os
from collections import Counter
from pathlib import Path
from typing import Annotated

import tyro

from camera_node.protocol.session import open_client
from fusion.bridges.ros2 import PoseQueue, Ros2Node, parse_domain, parse_namespace
from fusion.client.arena import Arena

log = logging.getLogger("fusion.ros2")


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
        ros: endpoints of ROS 2's own Zenoh router (rmw_zenohd), if the nodes do not use the server's.
        domain: ROS 2's domain; that of ROS_DOMAIN_ID, or 0, unless given.
        namespace: prefix of the robots' topics, such as lab1.
        frame: the name of the world in headers and in tf.
        humble: the nodes are of ROS 2 Humble, whose topics have no type hash.
    """
    ros_domain = parse_domain(os.environ.get("ROS_DOMAIN_ID", "0") if domain is None else str(domain))
    prefix = parse_namespace(namespace)
    with contextlib.ExitStack() as stack:
        client = stack.enter_context(Arena.connect(*connect, arena=arena, zenoh_config=zenoh_config))
        session = stack.enter_context(open_client(ros or connect, None if ros else zenoh_config))
        node = Ros2Node(session, ros_domain, prefix, humble)
        stack.callback(_log_faults, node.faults, client.faults)
        poses = PoseQueue(client, node.faults)
        stack.callback(poses.close)
        with contextlib.suppress(KeyboardInterrupt):
            poses.publish(node, frame, f"arena '{arena}' at {' '.join(connect)}")
    return 0


def _log_faults(*faults: Counter[str]) -> None:
    for reason, count in sum(faults, Counter[str]()).items():
        log.warning("%d %s", count, reason)
