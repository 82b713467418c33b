# SPDX-License-Identifier: BSD-3-Clause
"""The whole arena end to end, as `make demo` runs it: every program real, only the light is simulated."""

import re
import socket
import subprocess
import sys
from pathlib import Path

import psutil


def run_demo(scene: Path, *arguments: str, timeout_s: float = 150.0) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "web", "--demo", "--headless", "--scene", str(scene), *arguments]
    return subprocess.run(command, capture_output=True, text=True, timeout=timeout_s, check=False)


def test_from_a_wave_to_poses_that_are_right(scene: Path):
    """Exit code 0 says: every robot within 5 mm RMS and never lost for 0.5 s; the summary has a line for each."""
    result = run_demo(scene, "--seconds", "5")
    assert result.returncode == 0, result.stdout + result.stderr
    assert re.search(r"calibrated: 4 cameras", result.stdout)
    for robot in ("rover", "drone", "puck"):
        assert re.search(
            rf"^{robot}: position [0-9.]+ mm RMS.* tracked [0-9.]+ %", result.stdout, re.MULTILINE
        )
    assert re.search(r"^latency: [0-9.]+ ms p50", result.stdout, re.MULTILINE)
    assert re.search(r"^frames/s: ", result.stdout, re.MULTILINE)
    assert "all robots were tracked, and right" in result.stdout
    mine = [
        p for p in psutil.process_iter(["cmdline"]) if str(scene.parent) in " ".join(p.info["cmdline"] or ())
    ]
    assert not mine, "the demo left programs behind"


def test_a_broken_file_is_one_line(scene: Path):
    """Exit code 2, and the line names the file."""
    (scene.parent / "robots.yaml").write_text("robots: {rover: {diameter_m: wide}}")
    result = run_demo(scene, "--seconds", "5")
    assert result.returncode == 2
    assert result.stderr.count("\n") == 1
    assert "robots.yaml" in result.stderr
    assert "diameter_m" in result.stderr


def test_a_taken_endpoint_is_one_line(scene: Path):
    """The server's own line, passed on."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        endpoint = f"tcp/127.0.0.1:{server.getsockname()[1]}"
        result = run_demo(scene, "--listen", endpoint, "--seconds", "5")
    assert result.returncode == 2
    assert result.stderr.count("\n") == 1
    assert endpoint in result.stderr
