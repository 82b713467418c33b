# SPDX-License-Identifier: BSD-3-Clause
"""A server is killed: every bridge stops, or sends its protocol's sign of loss, and no pose is passed on late."""

import re
import struct

import pytest
from pymavlink.dialects.v20 import common

from camera_node.protocol.session import open_client
from fusion.bridges.pose_queue import PoseQueue
from fusion.client.arena import Arena
from fusion.protocol.pose_messages import RobotPose
from tests.fusion.bridges.autopilot import Autopilot
from tests.fusion.bridges.foxglove_reader import FoxgloveClient
from tests.fusion.bridges.pose_server import (
    ARENA,
    PoseServer,
    bridge,
    moving_pose,
    publish_poses,
    server_process,
)
from tests.fusion.bridges.vrpn_reader import VrpnReader, serving
from tests.processes import first_line
from tests.waiting import wait_for


def states(poses: list[RobotPose]) -> list[str]:
    """Of the rover."""
    return [pose.state for pose in poses if pose.robot == "rover"]


def test_a_robot_without_recent_poses_is_passed_on_as_lost_once(endpoint: str):
    with server_process(endpoint) as server, Arena.connect(endpoint, arena=ARENA) as arena:
        queue, seen = PoseQueue(arena), []
        wait_for(lambda: "tracked" in states(queue.take(0.1)))
        server.kill()
        server.wait()
        wait_for(lambda: "lost" in seen, lambda: seen.extend(states(queue.take(0.1))))
        assert seen[-1] == "lost"
        assert seen.count("lost") == 1
        assert states(queue.take(0.5)) == []
        queue.close()


def test_a_pose_that_arrives_too_late_is_not_passed_on(endpoint: str):
    with (
        PoseServer(endpoint, (), lateness_ms=5000.0) as server,
        Arena.connect(endpoint, arena=ARENA) as arena,
    ):
        queue = PoseQueue(arena)
        wait_for(lambda: arena.time.now_ns() and arena.status().latest())
        with open_client([endpoint]) as session:

            def publish() -> None:
                publish_poses(session, [moving_pose("rover", server.now_ns() - 10**10)])

            wait_for(lambda: states(queue.take(0.01)) or queue.faults, publish)
            assert list(queue.faults) == ["poses that were too old when the bridge took them"]
        queue.close()


def test_vrpn_clients_get_a_warning(endpoint: str):
    with server_process(endpoint) as server, serving(endpoint) as port, VrpnReader(port) as reader:
        while reader.next()[1] != "vrpn_Tracker Pos_Quat":
            pass
        server.kill()
        server.wait()
        while (message := reader.next())[1] != "vrpn_Base text_message":
            pass
    sender, _, _, body = message
    assert sender == "rover"
    assert struct.unpack(">II", body[:8]) == (1, 0)  # vrpn_TEXT_WARNING
    assert body[8:] == b"rover is lost\0"


@pytest.mark.parametrize("message", ["odometry", pytest.param("vision", marks=pytest.mark.ci)])
def test_an_autopilot_learns_that_the_odometry_has_failed(endpoint: str, message: str):
    with (
        server_process(endpoint) as server,
        Autopilot() as autopilot,
        bridge(
            "mavlink",
            "rover",
            *("--connect", endpoint, "--to", f"udp:127.0.0.1:{autopilot.port}", "--message", message),
        ),
    ):
        wait_for(lambda: autopilot.receive("HEARTBEAT").system_status == common.MAV_STATE_ACTIVE)
        server.kill()
        server.wait()
        if message == "odometry":
            wait_for(lambda: autopilot.receive("ODOMETRY").quality == -1)
            again = autopilot.receive("ODOMETRY")  # a datagram may be lost
            assert again.quality == -1
        wait_for(lambda: autopilot.receive("HEARTBEAT").system_status == common.MAV_STATE_CRITICAL)
        assert autopilot.link.recv_match(type="VISION_POSITION_ESTIMATE") is None


def test_foxglove_shows_no_robot_where_it_is_no_more(endpoint: str):
    with (
        server_process(endpoint) as server,
        bridge("foxglove", "--connect", endpoint, "--port", "0") as process,
    ):
        match = re.search(r":(\d+)$", first_line(process))
        assert match
        with FoxgloveClient(int(match[1])) as client:
            client.next("/tf")
            server.kill()
            server.wait()
            _, _, entry = client.next("/log")
            assert entry.message == "rover is lost"
            _, _, update = client.next("/scene")
            assert [deletion.id for deletion in update.deletions] == ["rover"]
