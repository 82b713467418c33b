# SPDX-License-Identifier: BSD-3-Clause
"""The command that measures a robot in a running arena and declares it."""

import subprocess
import sys

import pytest

from fusion.errors import FusionError
from fusion.model.robots import load_robots
from tests.conftest import ROOT, free_port
from tests.fusion.unknown_robot import serving_an_unknown_robot
from tests.processes import run_program
from tests.waiting import DEADLINE_S, wait_for


def run_define(endpoint: str, *words: str) -> subprocess.CompletedProcess[str]:
    return run_program("fusion", "define", *words, "--connect", endpoint, "--arena", "test")


def test_a_robot_in_a_running_arena_is_defined_and_replaced_on_request_only(tmp_path):
    """By the command, while the server tracks another one; the output is an entry for robots.yaml. A declared name is
    refused before the measurement, and its declaration stays."""
    with serving_an_unknown_robot(tmp_path) as (endpoint, client):
        done = run_define(endpoint, "b", "--diameter", "0.12", "--seconds", "1", "--motion", "ground")
        assert done.returncode == 0, done.stderr
        assert "the server now tracks b, with 3 markers" in done.stdout
        wait_for(lambda: client.robot("b", DEADLINE_S).next().state == "tracked")
        robots = client.change_robots()
        assert set(robots) == {"a", "b"}
        path = tmp_path / "measured.yaml"
        path.write_text("robots:\n" + done.stdout.partition("robots.yaml:\n")[2])
        assert load_robots(path) == {"b": robots["b"]}
        with pytest.raises(FusionError, match="no robot 'c'"):
            client.change_robots(remove=["c"])
        client.change_robots(remove=["b"])
        refused = run_define(endpoint, "a", "--diameter", "0.12")
        assert (refused.returncode, "add --replace" in refused.stderr) == (2, True)
        assert client.declared_robots().robots == {"a": robots["a"]}
        done = run_define(endpoint, "a", "--diameter", "0.12", "--seconds", "1", "--replace")
        assert done.returncode == 0, done.stderr
        assert client.declared_robots().robots["a"] != robots["a"]


def test_a_misspelt_command_gets_a_suggestion():
    done = run_program("fusion", "defined", "b")
    assert (done.returncode, done.stderr.count("\n")) == (2, 1)
    assert "did you mean define?" in done.stderr


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("b/c", "--diameter", "0.12"), "can't name a robot"),
        (("b", "--diameter", "0.12", "--seconds", "-1"), "above 0"),
    ],
)
def test_an_invalid_definition_is_reported_in_one_line(words, said):
    done = run_define(f"tcp/127.0.0.1:{free_port()}", *words)
    assert done.returncode == 2
    assert said in done.stderr
    assert done.stderr.count("\n") == 1


LIGHT = """
import sys
import fusion.__main__, fusion.client.arena, fusion.client.robot_definition
import fusion.commands.define, fusion.commands.bridges.ros2, fusion.commands.history
heavy = {"gtsam", "scipy", "viser", "mcap", "fusion.server", "fusion.tracking"} & set(sys.modules)
sys.exit(", ".join(sorted(heavy)) or 0)
"""


def test_clients_and_bridges_import_neither_the_server_nor_its_libraries():
    """A robot's computer has none of them: the client, `define`, `undo`, `ros2`, and the help of the server."""
    for words in (["-c", LIGHT], ["-X", "importtime", "-m", "fusion", "--help"]):
        done = subprocess.run([sys.executable, *words], cwd=ROOT, capture_output=True, text=True, timeout=120)
        assert done.returncode == 0, done.stderr
        assert "gtsam" not in done.stderr
