# SPDX-License-Identifier: BSD-3-Clause
"""How the demo ends: killed, by a mistake, without its port; `test_readme.py` runs it to its verdict."""

import socket
import subprocess
import sys
from pathlib import Path

import psutil
import pytest

from tests.waiting import DEADLINE_S, wait_for
from web.demo.arena_demo import Demo, conclude


def run_demo(scene: Path, *arguments: str, timeout_s: float = 150.0) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "web", "--demo", "--headless", "--scene", str(scene), *arguments]
    return subprocess.run(command, capture_output=True, text=True, timeout=timeout_s, check=False)


def test_a_killed_demo_leaves_no_program(scene: Path):
    """SIGKILL gives the demo no chance to stop its children; they end because it ended."""
    command = [sys.executable, "-m", "web", "--demo", "--headless", "--scene", str(scene)]
    demo = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        wait_for(lambda: len(psutil.Process(demo.pid).children()) >= 6)  # server, four cameras, calibration
        children = psutil.Process(demo.pid).children(recursive=True)
    finally:
        demo.kill()
        demo.wait()
    _, running = psutil.wait_procs(children, timeout=DEADLINE_S)
    assert not running


def test_an_invalid_file_is_one_line(scene: Path):
    """Exit code 2, and the line names the file and the field."""
    (scene.parent / "robots.yaml").write_text("robots: {rover: {diameter_m: wide}}")
    result = run_demo(scene, "--seconds", "5")
    assert result.returncode == 2
    assert result.stderr.count("\n") == 1
    assert "robots.yaml" in result.stderr
    assert "diameter_m" in result.stderr


def test_a_taken_endpoint_is_one_line(scene: Path):
    """Exit code 2, with the error of the server."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        endpoint = f"tcp/127.0.0.1:{server.getsockname()[1]}"
        result = run_demo(scene, "--listen", endpoint, "--seconds", "5")
    assert result.returncode == 2
    assert result.stderr.count("\n") == 1
    assert endpoint in result.stderr


@pytest.mark.ci
def test_a_second_demo_finds_another_port(scene: Path, tmp_path: Path):
    """Whether or not a program of this machine has the usual port, now or while the first starts, they differ."""
    folders = [tmp_path / name for name in ("first", "second")]
    for folder in folders:
        folder.mkdir()
    with Demo(scene, folders[0]) as first, Demo(scene, folders[1]) as second:
        assert first.endpoint != second.endpoint


def test_a_demo_that_a_user_ends_does_not_fail():
    """Only a demo with --seconds is a test: a gap in minutes of watching is reported, and the exit code is 0."""
    faults = ["rover: not tracked for 0.61 s (limit 0.5 s)"]
    assert conclude([], is_test=True)[1] == conclude([], is_test=False)[1] == 0
    text, code = conclude(faults, is_test=False)
    assert (code, "FAILED" in text, faults[0] in text) == (0, False, True)
    assert conclude(faults, is_test=True) == (f"FAILED: {faults[0]}", 1)
