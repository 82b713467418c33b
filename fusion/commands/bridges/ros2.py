# SPDX-License-Identifier: BSD-3-Clause
"""`roundel ros2`: an arena's robots as topics of ROS 2."""

import contextlib
import os

from camera_node.foundation.errors import ConfigError
from camera_node.foundation.service import stopped_by_signals
from camera_node.foundation.terminal import say
from camera_node.protocol.server_connection import LOCAL_SERVER, ConnectionOptions, ServerConnection
from camera_node.protocol.session import BURST_BUFFER
from fusion.bridges.pose_queue import WAIT_S, log_faults, receive_poses
from fusion.bridges.ros2_dds import DdsParticipant
from fusion.bridges.ros2_node import MessageSet, Ros2Node, parse_domain, parse_namespace
from fusion.bridges.ros2_zenoh import ZenohNode


def ros2(
    *,
    connection: ConnectionOptions = LOCAL_SERVER,
    dds: bool = False,
    ros: tuple[str, ...] | None = None,
    domain: int | None = None,
    namespace: str = "",
    frame: str = "world",
    sets: tuple[MessageSet, ...] = (),
    humble: bool = False,
    relative: tuple[str, ...] = (),
) -> int:
    """Publish an arena's robots to ROS 2 until stopped: over Zenoh, for nodes that run with
    RMW_IMPLEMENTATION=rmw_zenoh_cpp, or over DDS, for all others.

    Args:
        connection: the arena's server.
        dds: publish over DDS, which all nodes use that run without rmw_zenoh_cpp; needs roundel[dds], and no ROS.
        ros: endpoints of ROS 2's own Zenoh router (rmw_zenohd), if the nodes do not use the server's.
        domain: ROS 2's domain; that of ROS_DOMAIN_ID, or 0, unless given.
        namespace: prefix of the robots' topics, such as lab1.
        frame: the name of the world in headers and in tf.
        sets: publish all robots in one message, too: poses of Crazyswarm2, rigid_bodies of mocap4r2.
        humble: the nodes are of ROS 2 Humble, whose topics have no type hash.
        relative: cameras that locate roundels by themselves, as on a robot; publish what they locate, too.

    Raises:
        ConfigError: options contradict each other, or cyclonedds is missing.
    """
    if dds and (ros or humble):
        raise ConfigError("--ros and --humble are of ROS 2 over Zenoh; leave them out, or leave out --dds")
    ros_domain = parse_domain(os.environ.get("ROS_DOMAIN_ID", "0") if domain is None else str(domain))
    prefix = parse_namespace(namespace)
    with (
        stopped_by_signals() as stop,
        receive_poses(connection) as poses,
        contextlib.ExitStack() as stack,
    ):
        if dds:
            middleware = DdsParticipant(ros_domain)
        else:
            config = None if ros else connection.zenoh
            router = stack.enter_context(ServerConnection(ros or connection.connect, config, BURST_BUFFER))
            if (session := router.wait_unless(stop)) is None:
                return 0
            middleware = ZenohNode(session, ros_domain, prefix, humble)
        node = Ros2Node(middleware, prefix, sets)
        say(f"ROS 2 over {'DDS' if dds else 'Zenoh'}, domain {ros_domain}")
        for camera in relative:
            poses.client.relative(camera).on_message(node.publish_relative)
        while not stop.is_set():
            node.publish(poses.take(WAIT_S), frame)
        log_faults(node.faults)
    return 0
