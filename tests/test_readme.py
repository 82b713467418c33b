# SPDX-License-Identifier: BSD-3-Clause
"""Runs the commands of README.md and of the pages about a first arena, with shorter times and reserved ports."""

import contextlib
import itertools
import re
import shlex
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import cv2
import psutil
import pytest

from camera_node.foundation.errors import TEMPORARY_FAILURE
from tests.calib.boards import SPEC, board_poses, render
from tests.conftest import ROOT, free_port
from tests.pages import PYTHON, commands, page, programs
from tests.processes import run_here
from tests.waiting import wait_for_port
from tests.web.roundel.programs import Program
from web.roundel.command import execute

README = (ROOT / "README.md").read_text()
# With README.md, the pages whose commands run here.
PAGES = ("calibration.md", "first_arena.md", "offline.md", "troubleshooting.md")
DEADLINE_S = 120.0
MAIN = "from web.roundel.command import main; main()"  # of the command `roundel`


COMMANDS = dict.fromkeys([*commands(README), *itertools.chain(*map(page, PAGES)), *page("lab.md")])
OWN = [command for command in COMMANDS if command not in page("lab.md")]


def find(start: str) -> str:
    """Return the one command of the pages that begins with a text."""
    (command,) = [command for command in COMMANDS if command.startswith(start)]
    return command


def words(command: str) -> list[str]:
    """Return the command for subprocess, with this Python."""
    return [sys.executable, "-P", "-c", MAIN, *shlex.split(command)[1:]]


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A folder with the files of a clone that the commands name."""
    shutil.copytree(ROOT / "configs", tmp_path / "configs")
    return tmp_path


def run(command: str, folder: Path, expected: int = 0) -> subprocess.CompletedProcess[str]:
    done = run_here(lambda: execute(*shlex.split(command)[1:]), folder)
    assert done.returncode == expected, f"{command}\n{done.stdout}\n{done.stderr}"
    return done


def test_every_command_has_a_test():
    """A command that is added to the README, or to one of the pages, needs a test here."""
    tested = (
        *("make demo", 'make demo ARGS="--headless', "make test", "make check"),  # test_demo.py, .ci/run
        *("python3 -m venv ~/roundel", "~/roundel/bin/pip install"),  # test_packaging.py
        "~/roundel/bin/roundel demo",  # test_demo.py
        *("roundel print", "roundel detect", "roundel simulate", "roundel calibrate"),
        *("roundel up", "roundel camera", "roundel define", "roundel run", "roundel verify"),
    )
    assert [command for command in OWN if not command.startswith(tested)] == []


def test_the_readme_is_short():
    """At most 700 words, with one picture, which is in the repository."""
    assert len(README.split()) <= 700
    assert re.findall(r"!\[[^]]*\]\(([^)]*)\)", README) == ["docs/demo.webp"]
    assert (ROOT / "docs" / "demo.webp").exists()


@pytest.mark.parametrize("link", sorted(set(re.findall(r"\]\((?!http)([^)#]+)", README))))
def test_a_link_of_the_readme_leads_to_a_file(link: str):
    assert (ROOT / link).exists()


@pytest.mark.parametrize("command", [c for c in COMMANDS if c.startswith("make")])
def test_make_knows_its_targets(command: str):
    """A dry run; test_demo.py tests `make demo`, and `make test` runs this test."""
    done = subprocess.run(
        [*shlex.split(command), "-n"], cwd=ROOT, capture_output=True, timeout=60, check=False
    )
    assert done.returncode == 0, done.stderr


@pytest.mark.computed
def test_printing_and_detecting(folder: Path):
    """The sheet and the picture with the detections are written."""
    for thing in ("wand", "robot", "roundels"):
        run(find(f"roundel print {thing}"), folder)
    assert {path.name for path in folder.glob("*.pdf")} == {"wand.pdf", "rover.pdf", "roundels.pdf"}
    assert (folder / "wand.yaml").read_text().startswith("diameter_m: 0.09")
    frames = "roundel simulate configs/demo/scene.yaml frames --start 16 --seconds 0.1"
    run(frames, folder)
    shutil.copy(min((folder / "frames" / "north").iterdir()), folder / "picture.png")
    output = run(find("roundel detect"), folder).stdout
    assert re.search(r"picture.png: \d+ roundels", output)
    assert "wrote seen.png" in output
    assert cv2.imread(str(folder / "seen.png")) is not None


@pytest.mark.computed
def test_the_plan(folder: Path):
    """The README's figure of the planned arena is what the planner computes."""
    text = run("roundel plan configs/plan.yaml", folder).stdout
    (share,) = re.findall(r"two cameras or more see (\d+ %) of it", README)
    assert f"two cameras or more see {share.replace(' ', '')} of the area" in text


def test_an_arena_of_one_machine(folder: Path):
    """`roundel up` creates its folder and serves the page until it is stopped; the README's program names its arena."""
    port, endpoint = free_port(), f"tcp/127.0.0.1:{free_port()}"
    up = Program([*words(find("roundel up")), "--port", str(port), "--listen", endpoint], folder)
    try:
        (name,) = re.findall(r"server of arena '(.*)' at", up.until("^server of arena"))
        wait_for_port(port)
    finally:
        assert up.stop(signal.SIGTERM) == 0
    (code,) = PYTHON.findall(README)
    assert f'arena="{name}"' in code
    assert {"arena.yaml", "wand.yaml", "cameras", "recordings"} <= {
        p.name for p in (folder / "lab").iterdir()
    }


@pytest.mark.computed
def test_lenses_and_world(folder: Path):
    """Pictures of a board become a rig; surveyed positions need calibrated cameras, or exit with an error."""
    (folder / "board" / "north").mkdir(parents=True)
    for k, pose in enumerate(board_poses(0.6)):
        cv2.imwrite(str(folder / "board" / "north" / f"{k}.png"), render(*pose))
    command = find("roundel calibrate intrinsics").replace("charuco:5x7:0.035", SPEC)
    assert "north" in run(command, folder).stdout
    (folder / "surveyed.csv").write_text("camera,x,y,z\nnorth,0,0,2\n")
    assert "error: " in run(find("roundel calibrate world"), folder, expected=2).stderr


@pytest.mark.ci
@pytest.mark.computed
def test_a_recording_from_frames_to_poses(folder: Path):
    """A shorter recording of the simulator at half the frame rate; the poses contain all three robots."""
    scene = folder / "configs" / "demo" / "scene.yaml"
    text, count = re.subn(r"fps: ([0-9.]+)", lambda rate: f"fps: {float(rate[1]) / 2}", scene.read_text())
    assert count == 4
    scene.write_text(text)
    shorter = {"--seconds 15": "--seconds 8", "--seconds 5": "--seconds 1"}
    for command in page("offline.md"):
        for long, short in shorter.items():
            command = re.sub(rf"{long}$", short, command)
        run(command, folder)
    rows = (folder / "poses.csv").read_text().splitlines()[1:]
    assert {row.split(",")[1] for row in rows if ",tracked," in row} == {"rover", "drone", "puck"}


@pytest.mark.slow
def test_a_recording_from_frames_to_poses_in_python(folder: Path):
    """The program of the page, with a shorter recording."""
    (code,) = programs("offline.md")
    code = code.replace("seconds=15", "seconds=8").replace("seconds=5", "seconds=1")
    command = [sys.executable, "-c", code]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=600, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("grade ")
    assert {line.split()[1] for line in done.stdout.splitlines() if " tracked " in line} == {
        "rover",
        "drone",
        "puck",
    }


@pytest.fixture
def server(folder: Path) -> Iterator[tuple[Path, str]]:
    """The server of docs/lab.md on a reserved port, and its endpoint."""
    endpoint = f"tcp/localhost:{free_port()}"
    command = [*words(find("roundel server --config configs/arena.yaml")), "--listen", endpoint]
    with subprocess.Popen(command, cwd=folder, stderr=subprocess.PIPE, text=True) as process:
        assert process.stderr is not None
        first = process.stderr.readline()
        assert endpoint in first, first
        yield folder, endpoint
        process.terminate()
        assert process.wait(20) == 0


def test_the_live_programs(server: tuple[Path, str]):
    """With that server: commands that need cameras exit with an error; the view serves its page."""
    folder, endpoint = server
    if not list(Path("/dev").glob("video*")):
        assert (
            "this machine has no camera" in run("roundel camera", folder, expected=TEMPORARY_FAILURE).stderr
        )
    (folder / "lab").mkdir()
    shutil.copy(ROOT / "configs" / "wand.yaml", folder / "lab" / "wand.yaml")
    wand = f"{find('roundel calibrate wand --live')} --seconds 2 --connect {endpoint}"
    assert "error: " in run(wand, folder, expected=2).stderr
    define = find("roundel define") + f" --connect {endpoint}"
    assert re.search("error: .*cameras", run(define, folder, expected=2).stderr)
    view = find("roundel view").replace("tcp/localhost:7447", endpoint)
    port = free_port()
    process = subprocess.Popen([*words(view), "--port", str(port)], cwd=folder, stdout=subprocess.DEVNULL)
    try:
        wait_for_port(port)
    finally:
        process.terminate()
        assert process.wait(20) == 0


@pytest.mark.ci
def test_the_demo_tracks_and_a_client_and_ros2_receive_poses(tmp_path: Path, scene: Path):
    """Exit code 0: each robot is within 5 mm RMS and has no gap above 0.5 s. The summary has a line for each.

    Where the machine is too slow for the cameras, the demo says so and is run again, twice at most.
    """
    code, text, line = run_demo_with_clients(tmp_path, scene)
    for _ in range(2):
        if code and "this machine is too busy" in text:
            code, text, line = run_demo_with_clients(tmp_path, scene)
    assert code == 0, text
    assert re.search(r"^calibrated: 4 cameras", text, re.MULTILINE)
    for robot in ("rover", "drone", "puck"):
        assert re.search(rf"^{robot}: position [0-9.]+ mm RMS.* tracked [0-9.]+ %", text, re.MULTILINE)
    assert re.search(r"^latency: [0-9.]+ ms p50", text, re.MULTILINE)
    assert re.search(r"^frames/s: ", text, re.MULTILINE)
    assert "PASSED" in text
    assert re.match(r"\d{19} \(.*\) \(.*\)", line), line
    running = [
        p for p in psutil.process_iter(["cmdline"]) if str(scene.parent) in " ".join(p.info["cmdline"] or ())
    ]
    assert not running, "a program of the demo still runs"


def run_demo_with_clients(folder: Path, scene: Path) -> tuple[int, str, str]:
    """Run the demo, the README's Python and `roundel ros2`.

    Returns:
        The demo's exit code, what it printed, and the Python program's first line.
    """
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    (code,) = PYTHON.findall(README)
    code = code.replace("tcp/localhost:7447", endpoint).replace('arena="arena"', 'arena="demo"')
    (folder / "follow.py").write_text(code)
    command = [sys.executable, "-m", "web", "--demo", "--headless", "--seconds", "8"]
    ros2 = words(f"roundel ros2 --connect {endpoint} --arena demo")
    with contextlib.ExitStack() as stack:

        def start(command: list[str]) -> Program:
            program = Program(command, folder)
            stack.callback(program.stop, signal.SIGTERM)
            return program

        demo = start([*command, "--listen", endpoint, "--scene", str(scene)])
        demo.until("^calibrated", DEADLINE_S)
        line = start([sys.executable, "follow.py"]).until(r"^\d{19} ")
        start(ros2).until("publishes /rover/odometry")
        return demo.wait(), demo.text, line
