# SPDX-License-Identifier: BSD-3-Clause
"""`roundel foxglove`: an arena live in Foxglove."""

from camera_node.foundation.service import stopped_by_signals
from camera_node.foundation.terminal import say
from camera_node.protocol.server_connection import LOCAL_SERVER, ConnectionOptions
from fusion.bridges.foxglove_server import ArenaContent, serving
from fusion.bridges.pose_queue import WAIT_S, receive_poses


def foxglove(
    *, connection: ConnectionOptions = LOCAL_SERVER, host: str = "127.0.0.1", port: int = 8765
) -> int:
    """Serve an arena to Foxglove (Open connection, Foxglove WebSocket), until stopped.

    Args:
        connection: the arena's server.
        host: the address to listen on; 0.0.0.0 for Foxglove on other machines. There are no passwords.
        port: of the websocket.
    """
    with (
        stopped_by_signals() as stop,
        serving(host, port, f"Roundel {connection.arena}") as (channels, chosen),
        receive_poses(connection) as poses,
        ArenaContent(poses.client, channels),
    ):
        say(f"Foxglove at ws://{host}:{chosen}")
        while not stop.is_set():
            channels.add_poses(poses.take(WAIT_S))
    return 0
