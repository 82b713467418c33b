# SPDX-License-Identifier: BSD-3-Clause
"""A client of all robots receives one message for each frame set, and has each robot's poses of it."""

import pytest

from camera_node.protocol.server_connection import ServerConnection
from fusion.client.arena import Arena
from tests.conftest import free_port
from tests.fusion.bridges.pose_server import ARENA, PoseServer
from tests.waiting import DEADLINE_S, wait_for

ROBOTS = ("rover", "drone")


def test_a_set_has_the_poses_of_all_robots_at_one_time():
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    with PoseServer(endpoint, ROBOTS) as server, Arena.connect(endpoint, arena=ARENA) as arena:
        poses = arena.pose_sets(DEADLINE_S).next()
        assert [pose.robot for pose in poses] == [*ROBOTS, "gone"]
        assert len({pose.t_ns for pose in poses}) == 1
        assert all(pose == server.published[pose.robot, pose.t_ns] for pose in poses)


@pytest.mark.parametrize("only", [None, "rover"])
def test_the_newest_pose_is_there_before_anyone_asks_for_the_robot(only: str | None):
    """A connection for one robot receives that robot's key, any other one all poses together."""
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    with (
        PoseServer(endpoint, ROBOTS) as server,
        Arena(ServerConnection((endpoint,)), ARENA, only or "*") as arena,
    ):
        wait_for(lambda: "rover" in arena.robots())
        pose = arena.robot("rover").latest()
        assert pose is not None
        assert pose == server.published["rover", pose.t_ns]
        assert arena.robot("rover", DEADLINE_S).next().t_ns > pose.t_ns
        assert arena.robots() == (("rover",) if only else ("drone", "gone", "rover"))
