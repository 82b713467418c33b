# SPDX-License-Identifier: BSD-3-Clause
"""Setting the system clock of the server's and the cameras' machine changes no pose."""

import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from camera_node.clocks.host_clock import unix_ahead_ns
from fusion.client.arena import Arena as Client
from fusion.protocol.messages import RobotPose
from fusion.server.server_clock import ServerClock
from tests.conftest import ROOT
from tests.fusion.moving_cameras import MOVING
from tests.fusion.serving import DEADLINE_S, config
from tests.fusion.settable_clock import SettableClock
from tests.waiting import Inbox, wait_for

SETTLED, WATCHED = 60, 90  # poses: two seconds to converge, three seconds after the clock is set
MAX_ERROR_M = 0.01


@pytest.mark.parametrize(
    "step_s", [0.5, -3600.0, *(pytest.param(s, marks=pytest.mark.slow) for s in (-0.5, 3600.0))]
)
def test_no_pose_changes_when_the_system_clock_is_set(tmp_path: Path, step_s: float):
    """Server and cameras are programs whose system clock is set while a robot drives at 0.94 m/s."""
    clock = SettableClock(tmp_path)
    server_ahead_ns = unix_ahead_ns()  # at the server's start the step is 0
    with running_arena(tmp_path, clock) as client:
        poses = Inbox()
        client.robot("a").on_pose(poses.put)
        assert poses.until(lambda items: sum(pose.state == "tracked" for pose in items) >= SETTLED)
        clock.set_ahead(step_s)
        n = len(poses.items)
        assert poses.until(lambda items: len(items) >= n + WATCHED)
        after = poses.items[n:]
    tracked = [pose for pose in after if pose.state == "tracked"]  # on a busy machine frames may be late
    assert len(tracked) > WATCHED / 3
    assert max(error_m(pose, server_ahead_ns) for pose in tracked) < MAX_ERROR_M


def test_the_time_is_unix_time_at_the_start_and_monotonic_since():
    clock = ServerClock()
    assert abs(clock.ahead_ns - unix_ahead_ns()) < 1e6  # two readings of both clocks on a busy machine
    before = clock.now_ns()
    assert clock.reply().monotonic_ahead_ns == clock.ahead_ns
    assert before <= clock.reply().t_ns <= clock.now_ns()


def error_m(pose: RobotPose, server_ahead_ns: int) -> float:
    """The distance between a pose and the truth at its time."""
    _, p = MOVING.motions["a"]((pose.t_ns - server_ahead_ns) * 1e-9)
    return float(np.linalg.norm(pose.position - p))


@contextmanager
def running_arena(folder: Path, clock: SettableClock) -> Iterator[Client]:
    """A server and cameras, each in a process with the settable clock; and a client of the server."""
    settings, path = config(folder), folder / "endpoints"
    files = ["--rig", str(settings.rig), "--robots", settings.robots, "--endpoints-file", str(path)]
    serve = [sys.executable, "-m", "fusion", "--arena", "test", "--listen", "tcp/127.0.0.1:0", *files]
    environment = clock.environment
    with subprocess.Popen(serve, cwd=ROOT, env=environment) as server:
        try:
            wait_for(path.exists)
            (endpoint,) = path.read_text().splitlines()
            publish = [sys.executable, "-m", "tests.fusion.moving_cameras", endpoint]
            with subprocess.Popen(publish, cwd=ROOT, env=environment) as cameras:
                try:
                    with Client.connect(endpoint, arena="test") as client:
                        client.robot("a", DEADLINE_S).next()
                        yield client
                finally:
                    cameras.terminate()
        finally:
            server.terminate()
