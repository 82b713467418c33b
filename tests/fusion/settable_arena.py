# SPDX-License-Identifier: BSD-3-Clause
"""A server and cameras that run as programs, on a machine whose system clock can be set."""

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from fusion.client.arena import Arena as Client
from fusion.protocol.pose_messages import RobotPose
from tests.conftest import ROOT
from tests.fusion.moving_cameras import MOVING
from tests.fusion.serving import config
from tests.fusion.settable_clock import SettableClock
from tests.processes import killed_at_end, running
from tests.waiting import DEADLINE_S, wait_for


def error_m(pose: RobotPose, server_ahead_ns: int) -> float:
    """The distance between a pose and the truth at its time."""
    _, p = MOVING.motions["a"]((pose.t_ns - server_ahead_ns) * 1e-9)
    return float(np.linalg.norm(pose.position - p))


@contextmanager
def running_arena(folder: Path, clock: SettableClock) -> Iterator[Client]:
    """A server and cameras, each in a process with the settable clock; and a client of the server."""
    settings, path = config(folder), folder / "endpoints"
    files = ["--rig", settings.rig, "--robots", settings.robots, "--endpoints-file", path]
    words = ["--arena", "test", "--listen", "tcp/127.0.0.1:0", *files]
    publish = [sys.executable, "-m", "tests.fusion.moving_cameras"]
    environment = clock.environment
    with running("fusion", *words, env=environment):
        wait_for(path.exists)
        (endpoint,) = path.read_text().splitlines()
        with (
            killed_at_end([*publish, endpoint], cwd=ROOT, env=environment),
            Client.connect(endpoint, arena="test") as client,
        ):
            client.robot("a", DEADLINE_S).next()
            yield client
