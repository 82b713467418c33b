# SPDX-License-Identifier: BSD-3-Clause
"""Runs `roundel` commands as processes, and reads what they print."""

import os
import re
import signal
import subprocess
import sys
import threading
from collections.abc import Sequence
from pathlib import Path

from tests.processes import run_here
from tests.waiting import DEADLINE_S, poll
from web.roundel.command import execute

MAIN = "from web.roundel.command import main; main()"


def roundel_command(*words: object) -> list[str]:
    """The command line of a `roundel` command with this Python."""
    return [sys.executable, "-P", "-c", MAIN, *map(str, words)]


class Program:
    """A running program and the lines that it printed so far."""

    def __init__(self, command: Sequence[str], folder: Path) -> None:
        env = {**os.environ, "PYTHONUNBUFFERED": "1"}
        self.process = subprocess.Popen(
            command, cwd=folder, env=env, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
        )
        self.lines: list[str] = []
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def _read(self) -> None:
        assert self.process.stdout is not None
        for line in self.process.stdout:
            self.lines.append(line)

    def until(self, pattern: str, deadline_s: float = DEADLINE_S) -> str:
        """Wait for a line that matches, and return it; a failure shows all lines."""

        def find() -> str | None:
            assert self.process.poll() is None or self._reader.is_alive(), self.text
            return next((line for line in list(self.lines) if re.search(pattern, line)), None)

        line = poll(find, deadline_s=deadline_s)
        assert line is not None, f"no line with {pattern!r} in time:\n{self.text}"
        return line

    @property
    def text(self) -> str:
        return "".join(self.lines)

    def wait(self, deadline_s: float = DEADLINE_S) -> int:
        """Wait until it ends by itself and all its lines are read; return its exit code."""
        code = self.process.wait(deadline_s)
        self._reader.join(deadline_s)
        return code

    def stop(self, number: int = signal.SIGINT) -> int:
        if self.process.poll() is None:
            self.process.send_signal(number)
        code = self.process.wait(30)
        self._reader.join(10)
        assert self.process.stdout is not None
        self.process.stdout.close()
        return code


def roundel(*words: object, folder: Path, expected: int = 0) -> str:
    """Run a command to its end, in this process; return what it printed, but for its log."""
    done = run_here(lambda: execute(*map(str, words)), folder)
    assert done.returncode == expected, done.stdout + done.stderr
    return done.stdout + done.stderr


def roundel_process(
    *words: object, folder: Path | None = None, **env: str
) -> subprocess.CompletedProcess[str]:
    """The same in a process of its own, which is in no checkout."""
    command = roundel_command(*words)
    return subprocess.run(
        command, cwd=folder, env={**os.environ, **env}, capture_output=True, text=True, timeout=DEADLINE_S
    )
