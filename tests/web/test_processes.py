# SPDX-License-Identifier: BSD-3-Clause
"""Child processes are watched, their failures are reported, and all of them are stopped at the end."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import psutil
import pytest

from tests.conftest import free_port
from tests.waiting import wait_for
from web.errors import WebError
from web.processes import Processes, ProgramFailed, interrupt_on_signals

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
def processes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Processes:
    """No process yet; it can start the modules above."""
    for name, text in PROGRAMS.items():
        (tmp_path / f"{name}.py").write_text(text)
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    return Processes(tmp_path)


def test_leaving_the_block_stops_all_processes(processes: Processes, monkeypatch: pytest.MonkeyPatch):
    """Both a process that ends at SIGTERM and one that ignores it."""
    monkeypatch.setattr("web.processes.GRACE_S", 0.3)
    with processes:
        for name in ("lasting", "stubborn"):
            processes.start(name, name, [])
            wait_for(lambda name=name: (processes.folder / f"{name}.log").read_text() == "up\n")
        processes.check()
        pids = processes.pids()
        assert processes.measure() > 0
        assert processes.peak_bytes > 10e6
    assert len(pids) == 2
    assert not any(psutil.pid_exists(pid) for pid in pids)


def test_a_fault_that_the_user_can_correct_is_passed_on(processes: Processes):
    """The message of the child becomes the message of the error."""
    with processes:
        processes.start("fusion", "invalid", [])
        with pytest.raises(WebError, match=r"^fusion: robots.yaml: no such key$"):
            wait_for(lambda: processes.finished("fusion"))


def test_a_crash_quotes_the_log(processes: Processes):
    """With the exit code and the path of the log."""
    with processes:
        processes.start("cam0", "crashing", [])
        with pytest.raises(ProgramFailed, match=r"cam0.* 1; .*cam0.log\n(.*\n)*.*odd"):
            wait_for(lambda: processes.finished("cam0"))


def test_an_unexpected_end_is_a_failure(processes: Processes):
    """A camera that ends with exit code 0 has failed; a calibration has not."""
    with processes:
        processes.start("calib", "done", [])
        wait_for(lambda: processes.finished("calib"))
        processes.check("calib")
        with pytest.raises(ProgramFailed, match="calib stopped with code 0"):
            processes.check()


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
