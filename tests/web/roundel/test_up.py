# SPDX-License-Identifier: BSD-3-Clause
"""`roundel up` and `roundel camera`: real processes on loopback, simulated images."""

import re
import signal
from collections.abc import Iterator
from pathlib import Path

import psutil
import pytest
import yaml

from fusion.client import Arena
from tests.conftest import free_port
from tests.waiting import DEADLINE_S, wait_for
from tests.web.roundel.programs import Program, roundel, roundel_command

WAND_S = 60.0


@pytest.fixture
def start(tmp_path: Path) -> Iterator:
    """`start(*words)` runs a command in `tmp_path` until the test ends."""
    programs: list[Program] = []

    def run(*words: object) -> Program:
        programs.append(Program(roundel_command(*words), tmp_path))
        return programs[-1]

    yield run
    for program in reversed(programs):
        program.stop()


@pytest.mark.slow  # the wand is waved for as long as all programs need to start on a loaded machine
def test_from_unknown_cameras_to_poses_with_two_commands(start, scene: Path, tmp_path: Path):
    """Two programs with two cameras each, none of them known, become poses in a Python program.

    `up` has one pair and `camera` the other, as on another machine. Nothing is edited, and no lens is calibrated with a
    board: the wand finds them. The robots are those of the scene, declared in the arena's folder beforehand.
    """
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    folder, simulation = tmp_path / "lab", ("--scene", scene)
    scene.write_text(re.sub(r"(?m)^wave_s: .*", f"wave_s: {WAND_S}", scene.read_text()))
    folder.mkdir()
    (folder / "robots.yaml").write_text((scene.parent / "robots.yaml").read_text())
    up = start(
        "up", folder, "--headless", "--listen", endpoint, *simulation, "--source", "sim:north", "sim:east"
    )
    up.until("server of arena")
    camera = start("camera", "--connect", endpoint, *simulation, "--source", "sim:south", "sim:west")
    for name in ("south", "west"):
        camera.until(f"camera {name} publishes")
    connect = ("--connect", endpoint)
    wand = ("--wand", scene.parent / "wand.yaml", "--rig", folder / "rig.yaml", "--out", folder / "rig.yaml")
    text = roundel("calibrate", "wand", "--live", "--seconds", 12, *wand, *connect, folder=tmp_path)
    assert "no lens known of east, north, south, west" in text
    assert "in force on the server" in text
    with Arena.connect(endpoint, arena="arena") as arena:
        poses = arena.robot("rover", timeout_s=60.0)
        assert wait_for(lambda: (pose := poses.next()).state == "tracked" and pose, deadline_s=2 * WAND_S)
    assert {path.stem for path in (folder / "cameras").glob("*.yaml")} == {"north", "east", "south", "west"}
    children = psutil.Process(up.process.pid).children(recursive=True)
    assert camera.stop() == 0
    assert up.stop() == 0
    assert not psutil.wait_procs(children, timeout=DEADLINE_S)[1]


@pytest.mark.ci
def test_a_camera_keeps_its_name_and_its_settings(start, tmp_path: Path):
    """Renamed and changed while it runs, it has both after a restart of all programs; so has an edited file."""
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    up = ("up", "lab", "--headless", "--listen", endpoint, "--source")
    arena = start(*up, "sim:north")
    arena.until("camera north publishes")
    connect = ("--connect", endpoint)
    roundel("cameras", "rename", "north", "door", *connect, folder=tmp_path)
    arena.until("camera door publishes")
    assert "min_contrast: 40" in roundel("settings", "door", "--min-contrast", 40, *connect, folder=tmp_path)
    assert "there are: door" in roundel("cameras", "forget", "dor", *connect, folder=tmp_path, expected=2)
    stored = tmp_path / "lab" / "cameras" / "door.yaml"
    wait_for(lambda: yaml.safe_load(stored.read_text()).get("settings") == {"min_contrast": 40})
    assert arena.stop(signal.SIGTERM) == 0
    again = start(*up, "sim:north")
    again.until("camera door is here again")
    again.until("camera door publishes")
    assert "min_contrast: 40" in roundel("settings", "door", *connect, folder=tmp_path)
    assert [path.name for path in stored.parent.glob("*.yaml")] == ["door.yaml"]


def test_a_camera_with_a_wrong_name_is_not_started_again(start, tmp_path: Path):
    """The error names what it needs; the rest of the arena runs."""
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    up = start("up", "lab", "--headless", "--listen", endpoint, "--source", "nosuch", "sim:north")
    up.until("camera nosuch: needs a correction")
    up.until("camera north publishes")
    assert "no folder, video or camera 'nosuch'" in up.text
    assert "starting it again" not in up.text
    assert up.stop(signal.SIGTERM) == 0


@pytest.mark.ci
def test_a_server_that_can_not_start_ends_the_command(start, tmp_path: Path):
    """Exit code and error are the server's: a broken file needs a user."""
    (tmp_path / "lab").mkdir()
    (tmp_path / "lab" / "robots.yaml").write_text("robots: {rover: {diameter_m: wide}}")
    listen = ("--listen", f"tcp/127.0.0.1:{free_port()}")
    up = start("up", "lab", "--headless", *listen, "--source")
    assert up.process.wait(60) == 2
    up.stop()
    assert re.search(r"error: .*robots.yaml.*diameter_m", up.text)


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (("up", "x/y", "--arena", "a/b"), "'a/b' can't name an arena"),
        (("camera", "--name", "a"), "--name names one camera"),
        (("camera", "--zenoh", "x.json5", "--source", "0"), "--zenoh needs --connect"),
        (("cameras", "rename", "a"), "use roundel cameras rename OLD NEW"),
        (("cameras", "forget", "a", "b"), "use roundel cameras forget NAME"),
    ],
)
def test_mistakes_are_one_line(words: tuple[str, ...], says: str, tmp_path: Path):
    text = roundel(*words, folder=tmp_path, expected=2)
    assert re.fullmatch(rf"error: .*{re.escape(says)}.*\n", text)
