# SPDX-License-Identifier: BSD-3-Clause
"""`roundel ros2`: an arena's robots as topics of ROS 2."""

import os

from camera_node.foundation.service import stopped_by_signals
from camera_node.foundation.terminal import say
from camera_node.protocol.server_connection import LOCAL_SERVER, ConnectionOptions, ServerConnection
from camera_node.protocol.session import BURST_BUFFER
from fusion.bridges.pose_queue import WAIT_S, log_faults, receive_poses
from fusion.bridges.ros2_node import Ros2Node, parse_domain, parse_namespace


def ros2(
    *,
    connection: ConnectionOptions = LOCAL_SERVER,
    ros: tuple[str, ...] | None = None,
    domain: int | None = None,
    namespace: str = "",
    frame: str = "world",
    humble: bool = False,
    relative: tuple[str, ...] = (),
) -> int:
    """Publish an arena's robots to ROS 2, for nodes that run with RMW_IMPLEMENTATION=rmw_zenoh_cpp, until stopped.

    Args:
        connection: the arena's server.
        ros: endpoints of ROS 2's own Zenoh router (rmw_zenohd), if the nodes do not use the server's.
        domain: ROS 2's domain; that of ROS_DOMAIN_ID, or 0, unless given.
        namespace: prefix of the robots' topics, such as lab1.
        frame: the name of the world in headers and in tf.
        humble: the nodes are of ROS 2 Humble, whose topics have no type hash.
        relative: cameras that locate roundels by themselves, as on a robot; publish what they locate, too.
    """
    ros_domain = parse_domain(os.environ.get("ROS_DOMAIN_ID", "0") if domain is None else str(domain))
    prefix = parse_namespace(namespace)
    with (
        stopped_by_signals() as stop,
        receive_poses(connection) as poses,
        ServerConnection(
            ros or connection.connect, None if ros else connection.zenoh, BURST_BUFFER
        ) as router,
    ):
        if (session := router.wait_unless(stop)) is None:
            return 0
        node = Ros2Node(session, ros_domain, prefix, humble)
        say(f"ROS 2, domain {ros_domain}")
        for camera in relative:
            poses.client.relative(camera).on_message(node.publish_relative)
        while not stop.is_set():
            node.publish(poses.take(WAIT_S), frame)
        log_faults(node.faults)
    return 0
