# SPDX-License-Identifier: BSD-3-Clause
"""The Python programs of docs/clients.md run as they are written there, with the endpoint and arena of the test."""

import subprocess
import sys

import pytest

from tests.conftest import ROOT, free_port
from tests.fusion.bridges.pose_server import ARENA, PoseServer
from tests.pages import programs
from tests.waiting import DEADLINE_S

FIRST, CALLBACK, AGE = programs("clients.md")


@pytest.mark.parametrize(
    ("program", "expected"),
    [
        (FIRST, "tracked"),
        *(pytest.param(*case, marks=pytest.mark.ci) for case in ((CALLBACK, "3 robots at"), (AGE, " s old"))),
    ],
)
def test_a_program_prints_poses(program: str, expected: str):
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    program = program.replace("tcp/localhost:7447", endpoint).replace('arena="demo"', f'arena="{ARENA}"')
    with PoseServer(endpoint):
        words = [sys.executable, "-c", program]
        done = subprocess.run(
            words, cwd=ROOT, capture_output=True, text=True, timeout=DEADLINE_S, check=False
        )
    assert done.returncode == 0, done.stderr
    assert expected in done.stdout
