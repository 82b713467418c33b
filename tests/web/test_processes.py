# SPDX-License-Identifier: BSD-3-Clause
"""Children are watched, their faults are told, and none is left behind."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import psutil
import pytest

from tests.conftest import free_port
from tests.web.conftest import wait_for
from web.errors import WebError
from web.processes import Processes, ProgramFailed, ended_by_signals

# Small modules that stand for the programs of an arena: they are run as `python -m NAME`.
PROGRAMS = {
    "lasting": "import threading; print('up', flush=True); threading.Event().wait()",
    "stubborn": "import signal, threading; signal.signal(signal.SIGTERM, signal.SIG_IGN); print('up', flush=True); "
    "threading.Event().wait()",
    "mendable": "import sys; print('error: robots.yaml: no such key', file=sys.stderr); sys.exit(2)",
    "crashing": "raise ValueError('odd')",
    "done": "pass",
}


@pytest.fixture
def processes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Processes:
    """Nothing started yet; the modules above can be."""
    for name, text in PROGRAMS.items():
        (tmp_path / f"{name}.py").write_text(text)
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    return Processes(tmp_path)


def ended(processes: Processes, name: str) -> bool:
    return processes.finished(name)


def test_leaving_stops_everything(processes: Processes, monkeypatch: pytest.MonkeyPatch):
    """Those that end when asked, and those that don't."""
    monkeypatch.setattr("web.processes.GRACE_S", 0.3)
    with processes:
        for name in ("lasting", "stubborn"):
            processes.start(name, name, [])
            wait_for(lambda name=name: (processes.folder / f"{name}.log").read_text() == "up\n")
        processes.check()
        pids = processes.pids()
        assert processes.processor_seconds() > 0
        assert processes.peak_bytes > 10e6
    assert len(pids) == 2
    assert not any(psutil.pid_exists(pid) for pid in pids)


def test_what_a_person_can_mend_is_passed_on(processes: Processes):
    """A child's own line becomes ours."""
    with processes:
        processes.start("fusion", "mendable", [])
        with pytest.raises(WebError, match=r"^fusion: robots.yaml: no such key$"):
            wait_for(lambda: ended(processes, "fusion"))


def test_a_crash_is_told_with_its_last_lines(processes: Processes):
    """And with the place of its log."""
    with processes:
        processes.start("cam0", "crashing", [])
        with pytest.raises(
            ProgramFailed, match=r"cam0 stopped with code 1; its log is .*cam0.log\n(.*\n)*.*odd"
        ):
            wait_for(lambda: ended(processes, "cam0"))


def test_an_end_that_was_not_expected_is_a_failure(processes: Processes):
    """A camera that ends well has failed; a calibration that does has not."""
    with processes:
        processes.start("calib", "done", [])
        wait_for(lambda: ended(processes, "calib"))
        processes.check("calib")
        with pytest.raises(ProgramFailed, match="stopped with code 0"):
            processes.check()


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP, signal.SIGINT])
def test_signals_leave_in_order(number: signal.Signals):
    """Each becomes KeyboardInterrupt, and the handlers of before are put back."""
    before = signal.getsignal(number)
    with pytest.raises(KeyboardInterrupt), ended_by_signals():
        os.kill(os.getpid(), number)
    assert signal.getsignal(number) == before


def run_web(*arguments: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "web", *arguments]
    return subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)


def test_faults_of_the_command_line_are_one_line(tmp_path: Path):
    """Exit code 2 and one line that names the file."""
    result = run_web("--demo", "--headless", "--scene", str(tmp_path / "none.yaml"))
    assert result.returncode == 2
    assert result.stderr.count("\n") == 1
    assert "none.yaml does not exist" in result.stderr


def test_the_status_line_needs_no_server():
    """Without one it says so, and ends by itself."""
    result = run_web("--headless", "--seconds", "1.5", "--connect", f"tcp/127.0.0.1:{free_port()}")
    assert result.returncode == 0
    assert result.stdout.splitlines()[0].startswith("no server answers yet | no camera")
