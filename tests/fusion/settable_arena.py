# SPDX-License-Identifier: BSD-3-Clause
"""A server and cameras that run as programs, on a machine whose system clock can be set."""

import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from fusion.client.arena import Arena as Client
from fusion.protocol.messages import RobotPose
from tests.conftest import ROOT
from tests.fusion.moving_cameras import MOVING
from tests.fusion.serving import DEADLINE_S, config
from tests.fusion.settable_clock import SettableClock
from tests.waiting import wait_for


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
