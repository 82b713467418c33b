# SPDX-License-Identifier: BSD-3-Clause
"""Failures of child processes are reported with their reason, and signals end a program by an exception."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import psutil
import pytest
from msgspec.structs import replace

from calib.rig.rig import Rig
from camera_node.foundation.supervisor import Supervisor, log_path
from camera_node.geometry.pose import Pose
from camera_node.simulation.scene import Scene
from tests.conftest import free_port
from tests.waiting import wait_for
from web.demo.arena_demo import (
    Demo,
    ProgramFailed,
    calibrated_lenses,
    interrupt_on_signals,
    raise_failure,
    require_poses,
)
from web.demo.score import ResourceUsage
from web.errors import WebError
from web.state.feed import Feed

# Small modules in place of the programs of an arena, run as `python -m NAME`.
PROGRAMS = {
    "lasting": "import threading; print('up', flush=True); threading.Event().wait()",
    "stubborn": "import signal, threading; signal.signal(signal.SIGTERM, signal.SIG_IGN); print('up', flush=True); "
    "threading.Event().wait()",
    "invalid": "import sys; print('error: robots.yaml: no such key', file=sys.stderr); sys.exit(2)",
    "crashing": "raise ValueError('odd')",
    "done": "pass",
}


@pytest.fixture
def supervisor(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Supervisor:
    """It can start the modules above; their ends are failures."""
    for name, text in PROGRAMS.items():
        (tmp_path / f"{name}.py").write_text(text)
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    return Supervisor(
        lambda name, code: raise_failure(name, code, log_path(tmp_path, name)), tmp_path, restarts=False
    )


def test_leaving_the_block_stops_all_programs(
    supervisor: Supervisor, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    """Both a program that ends at SIGTERM and one that ignores it; until then their use of resources is measured."""
    monkeypatch.setattr("camera_node.foundation.supervisor.GRACE_S", 0.3)
    with supervisor:
        for name in ("lasting", "stubborn"):
            supervisor.start(name, name, [])
            wait_for(lambda name=name: log_path(tmp_path, name).read_text() == "up\n")
        supervisor.tend()
        pids = supervisor.pids()
        usage = ResourceUsage(supervisor.pids, Feed("test"))
        assert usage.measure() > 0
        own = psutil.Process().memory_info().rss
        assert usage.peak_bytes > own + 2 * 5e6, "each interpreter has more than 5 MB"
    assert len(pids) == 2
    assert not any(psutil.pid_exists(pid) for pid in pids)


@pytest.mark.parametrize(
    ("program", "error", "text"),
    [
        ("invalid", WebError, r"^camera north: robots.yaml: no such key$"),
        ("crashing", ProgramFailed, r"camera north.* 1; .*camera-north.log\n(.*\n)*.*odd"),
        ("done", ProgramFailed, "camera north stopped with code 0"),
    ],
)
def test_an_end_is_a_failure_with_its_reason(
    supervisor: Supervisor, program: str, error: type[Exception], text: str
):
    """A fault that the user can correct is passed on; a crash quotes the log."""
    with supervisor:
        supervisor.start("camera north", program, [])
        with pytest.raises(error, match=text):
            wait_for(lambda: supervisor.tend())


def test_a_calibration_of_the_demo_may_end(scene: Path, tmp_path: Path):
    """With exit code 0 its work is done; a camera that ends so has failed."""
    folder = tmp_path / "arena"
    folder.mkdir()
    demo = Demo(scene, folder)
    demo._ended("calib", 0)
    (folder / "camera-sim-north.log").write_text("")
    with pytest.raises(ProgramFailed, match="camera sim:north stopped with code 0"):
        demo._ended("camera sim:north", 0)


def test_a_camera_without_a_pose_is_named_with_the_reason(scene: Path):
    """A wand session that the machine's load cut short may place some of the cameras only."""
    simulated = Scene.load(scene)
    lenses = calibrated_lenses(simulated)
    pose = Pose((0.0, 0.0, 3.0), (0.0, 1.0, 0.0, 0.0))
    placed = {name: replace(lens, T_world_cam=pose) for name, lens in lenses.items()}
    require_poses(Rig(cameras=placed), simulated.cameras)
    figures = {"unplaced": {"east": "it shares 3 wand positions with others"}}
    with pytest.raises(ProgramFailed, match="no pose for east: it shares 3 wand positions"):
        require_poses(Rig(cameras=placed | {"east": lenses["east"]}, calibration=figures), simulated.cameras)


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP, signal.SIGINT])
def test_signals_raise_keyboard_interrupt(number: signal.Signals):
    """And the previous handlers are restored."""
    before = signal.getsignal(number)
    with pytest.raises(KeyboardInterrupt), interrupt_on_signals():
        os.kill(os.getpid(), number)
    assert signal.getsignal(number) == before


def run_web(*arguments: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "web", *arguments]
    return subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)


def test_a_missing_scene_is_one_line(tmp_path: Path):
    """Exit code 2 and one line that names the file."""
    result = run_web("--demo", "--headless", "--scene", str(tmp_path / "none.yaml"))
    assert result.returncode == 2
    assert result.stderr.count("\n") == 1
    assert "none.yaml" in result.stderr


def test_the_status_line_needs_no_server():
    """Without a server it says so, and ends after the given time."""
    result = run_web("--headless", "--seconds", "1.5", "--connect", f"tcp/127.0.0.1:{free_port()}")
    assert result.returncode == 0
    assert result.stdout.splitlines()[0].startswith("no server found yet | no camera")
