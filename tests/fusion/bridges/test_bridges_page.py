# SPDX-License-Identifier: BSD-3-Clause
"""The commands of docs/bridges.md run as they are written there, with the endpoint and the port of the test."""

import re
import shlex
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import pytest

from calib.rig.recording import RecordingWriter
from camera_node.protocol.messages import encode
from tests.conftest import ROOT, free_port
from tests.fusion.bridges.pose_server import ARENA, PoseServer, moving_pose
from tests.processes import first_line
from tests.waiting import DEADLINE_S
from tests.web.roundel.programs import roundel, roundel_command

PAGE = (ROOT / "docs" / "bridges.md").read_text()
COMMANDS = [
    line for block in re.findall(r"```sh\n(.*?)```", PAGE, re.DOTALL) for line in block.splitlines() if line
]


@pytest.mark.parametrize(
    ("extra", "arguments"),
    [
        ("", ("vrpn", "--port", "0")),
        pytest.param("", ("ros2",), marks=pytest.mark.ci),
        pytest.param("pymavlink", ("mavlink", "rover", "--to", "udp:127.0.0.1:9"), marks=pytest.mark.ci),
        pytest.param("foxglove", ("foxglove", "--port", "0"), marks=pytest.mark.ci),
    ],
)
def test_a_bridge_needs_only_its_own_extra(extra: str, arguments: tuple[str, ...], endpoint: str):
    packages = {"gtsam", "scipy", "viser", "mcap", "psutil", "websockets", "ezc3d", "rosbags"}
    missing = (packages | {"pymavlink", "foxglove", "av"}) - {extra}
    code = (
        f"import sys; sys.modules.update(dict.fromkeys({missing}))\nfrom fusion.__main__ import main; main()"
    )
    words = [sys.executable, "-c", code, *arguments, "--connect", endpoint]
    with (
        PoseServer(endpoint),
        subprocess.Popen(words, cwd=ROOT, stdout=subprocess.PIPE, text=True) as process,
    ):
        try:
            assert first_line(process)
        finally:
            process.kill()


@pytest.mark.parametrize("command", [c for c in COMMANDS if " export " in c])
def test_the_page_exports(command: str, tmp_path: Path):
    _, *words = shlex.split(command)
    if words[-1].endswith(".rrd") and find_spec("rerun") is None:
        pytest.skip("rerun-sdk is not installed: pip install '.[rerun]'")
    with RecordingWriter(tmp_path / "monday.mcap") as writer:
        for k in range(10):
            pose = moving_pose("rover", 1_790_000_000_000_000_000 + k * 20_000_000)
            writer.put("x/robot/rover/pose", encode(pose), pose.t_ns)
    roundel(*words, folder=tmp_path)
    assert (tmp_path / words[-1]).exists()


def test_the_page_has_commands():
    assert len(COMMANDS) >= 2
    assert all(command.startswith("roundel ") for command in COMMANDS)


@pytest.mark.parametrize(
    "command",
    [pytest.param(c, marks=[] if " vrpn" in c else pytest.mark.ci) for c in COMMANDS if " export " not in c],
)
def test_a_bridge_of_the_page_runs_until_it_is_ended(command: str, endpoint: str, tmp_path: Path):
    _, *words = shlex.split(command)
    words += ["--connect", endpoint, "--arena", ARENA]
    if " ros2" not in command and " mavlink" not in command:
        words += ["--port", str(free_port())]  # another test may use the usual one
    with (
        PoseServer(endpoint),
        subprocess.Popen(roundel_command(*words), cwd=tmp_path, stdout=subprocess.PIPE, text=True) as process,
    ):
        try:
            assert first_line(process)
            process.terminate()
            # A comparison that ends early found no autopilot.
            assert process.wait(DEADLINE_S) == int("--check-s" in command)
        finally:
            process.kill()
