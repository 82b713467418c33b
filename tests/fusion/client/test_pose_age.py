# SPDX-License-Identifier: BSD-3-Clause
"""A pose has an age: it grows while the server is dead, and then no client calls a robot tracked."""

import math

import msgspec
import pytest

from camera_node.protocol.server_connection import ServerConnection
from fusion.client.arena import Arena
from fusion.client.server_time import ServerTime
from fusion.client.streams import RobotStream
from tests.conftest import free_port
from tests.fusion.bridges.pose_server import ARENA, PoseServer, moving_pose, server_process
from tests.waiting import wait_for

MAX_AGE_S = 0.5


def test_the_age_grows_after_the_server_was_killed_and_no_recent_pose_is_left():
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    with server_process(endpoint) as server, Arena.connect(endpoint, arena=ARENA) as arena:
        rover = arena.robot("rover")
        wait_for(lambda: rover.latest(MAX_AGE_S))
        server.kill()
        server.wait()
        first_s = rover.age_s()
        wait_for(lambda: rover.latest(MAX_AGE_S) is None)
        assert rover.age_s() > max(MAX_AGE_S, first_s)
        for stream in (arena.poses(), arena.pose_sets()):
            assert stream.latest(MAX_AGE_S) is None
            assert stream.age_s() > MAX_AGE_S
        pose = rover.latest()
        assert pose is not None
        assert pose.state == "tracked"  # its state when it was sent
        assert arena.age_s(pose) > MAX_AGE_S


@pytest.mark.parametrize("ahead_s", [-3600, 5])
def test_the_age_is_in_the_server_s_time(ahead_s: int):
    """A pose that was sent late is old on arrival, whatever the difference between the two machines' clocks."""
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    with (
        PoseServer(endpoint, ahead_ns=ahead_s * 10**9) as server,
        Arena(ServerConnection((endpoint,)), ARENA) as arena,
    ):
        rover = arena.robot("rover")
        wait_for(lambda: rover.latest(3.0))  # two readings of 5 s apart differ on a busy machine as well
        assert rover.age_s() >= 0.0
        late = moving_pose("rover", server.now_ns() - 10**10)
        assert arena.age_s(late) > 9.0


def test_the_age_is_at_least_the_time_since_arrival():
    """A server that starts again may count from a time at which the last pose seems to be new, or in the future."""
    now = ServerTime(latest_ns=10**18, monotonic_s=100.0)
    assert now.age_s(10**18 + 10**12, received_s=98.0) == 2.0
    assert now.age_s(10**18 - 3 * 10**9, received_s=98.0) == 3.0
    assert ServerTime(None, 100.0).age_s(10**18, received_s=100.0) == math.inf


def test_a_lost_robot_has_no_recent_pose_and_the_age_of_its_last_one():
    ages = {1: 3.0, 2: 0.0}
    stream = RobotStream("", None, lambda: "", lambda pose, _: ages[pose.t_ns], lambda: None)
    assert (stream.latest(), stream.age_s()) == (None, math.inf)
    stream._put(moving_pose("rover", 1))
    stream._put(moving_pose("rover", 2, state="lost"))
    assert stream.latest(MAX_AGE_S) is None
    assert stream.age_s() == 3.0
    assert stream.latest() == moving_pose("rover", 2, state="lost")


def test_a_pose_is_predicted_for_the_present_while_it_is_recent():
    """By the server's time, which the stream asks for."""
    pose = msgspec.structs.replace(
        moving_pose("rover", 10**18), acceleration_density=(1.0, 1.0), body_markers=3
    )
    ages, now_ns = {pose.t_ns: 0.02}, pose.t_ns + 20_000_000
    stream = RobotStream("", None, lambda: "", lambda pose, _: ages[pose.t_ns], lambda: now_ns)
    assert stream.now(MAX_AGE_S) is None
    stream._put(pose)
    assert stream.now(MAX_AGE_S) == pose.at(now_ns)
    ages[pose.t_ns] = 2 * MAX_AGE_S
    assert stream.now(MAX_AGE_S) is None
