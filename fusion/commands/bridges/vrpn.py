# SPDX-License-Identifier: BSD-3-Clause
"""`fusion vrpn`: an arena's robots as trackers of VRPN."""

from camera_node.foundation.service import stopped_by_signals
from camera_node.foundation.terminal import say
from fusion.bridges.pose_queue import LOCAL, Server, log_faults
from fusion.bridges.vrpn_server import VrpnServer


def vrpn(*, server: Server = LOCAL, host: str = "127.0.0.1", port: int = 3883) -> int:
    """Serve an arena's robots over VRPN (libmotioncapture, vrpn_mocap, Blender, MATLAB and others), until stopped.

    Args:
        server: the arena's server.
        host: the address to listen on; 0.0.0.0 for clients on other machines. VRPN knows no passwords.
        port: of TCP and UDP.
    """
    with (
        stopped_by_signals() as stop,
        VrpnServer(host, port) as trackers,
        server.receive_poses() as poses,
    ):
        say(f"VRPN on {host} port {trackers.port}")
        while not stop.is_set():
            trackers.step(poses)
        log_faults(trackers.faults)
    return 0
