# SPDX-License-Identifier: BSD-3-Clause
"""`roundel vrpn`: an arena's robots as trackers of VRPN."""

from camera_node.foundation.service import stopped_by_signals
from camera_node.foundation.terminal import say
from camera_node.protocol.server_connection import LOCAL_SERVER, ConnectionOptions
from fusion.bridges.pose_queue import log_faults, receive_poses
from fusion.bridges.vrpn_server import VrpnServer


def vrpn(*, connection: ConnectionOptions = LOCAL_SERVER, host: str = "127.0.0.1", port: int = 3883) -> int:
    """Serve an arena's robots over VRPN (libmotioncapture, vrpn_mocap, Blender, MATLAB and others), until stopped.

    Args:
        connection: the arena's server.
        host: the address to listen on; 0.0.0.0 for clients on other machines. VRPN knows no passwords.
        port: of TCP and UDP.
    """
    with (
        stopped_by_signals() as stop,
        VrpnServer(host, port) as trackers,
        receive_poses(connection) as poses,
    ):
        say(f"VRPN on {host} port {trackers.port}")
        while not stop.is_set():
            trackers.step(poses)
        log_faults(trackers.faults)
    return 0
