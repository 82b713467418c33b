# SPDX-License-Identifier: BSD-3-Clause
"""Runs programs as child processes, and starts those again that fail."""

import contextlib
import logging
import os
import re
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import IO

from camera_node.foundation.errors import USER_ERROR

log = logging.getLogger("roundel")

GRACE_S = 6.0  # between SIGTERM and SIGKILL; camera_node.foundation.child ends its program after 5 s
FIRST_DELAY_S, LONGEST_DELAY_S = 1.0, 30.0  # before a program is started again; doubles with each failure
STEADY_S = 60.0  # a program that ran for this long starts with the first delay again
# One thread per program: on few cores, threads of linear algebra libraries take time from the cameras.
ENVIRONMENT = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "PYTHONUNBUFFERED": "1"}


@dataclass
class _Program:
    """A program, its process, and when it is to be started again if the process ended."""

    module: str
    arguments: tuple[str, ...]
    process: subprocess.Popen
    since_s: float
    delay_s: float = FIRST_DELAY_S
    due_s: float | None = None


class Supervisor:
    """Children by name, which write to this program's stdout and stderr. Leaving the `with` block stops all of them.

    A child that ends with exit code 0 has done its work. One that ends with 2 needs a user and is not started again;
    after any other end it is started again, later after each failure. All end when this process ends, by any cause.

    Args:
        on_end: called with the name and the exit code of a child that ended and is not started again.
        logs: a folder for files `log_path(name)`, to which the children write instead.
        restarts: whether children that failed are started again.

    Attributes:
        folder: in which the children run; that of this process if None.
    """

    def __init__(
        self,
        on_end: Callable[[str, int], object] = lambda name, code: None,
        logs: Path | None = None,
        restarts: bool = True,
    ) -> None:
        self._programs: dict[str, _Program] = {}
        self._on_end, self._logs, self._restarts = on_end, logs, restarts
        self.folder: Path | None = None

    def __enter__(self) -> "Supervisor":
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()

    def __contains__(self, name: str) -> bool:
        return name in self._programs

    def __len__(self) -> int:
        return len(self._programs)

    def start(self, name: str, module: str, arguments: Sequence[str]) -> None:
        """Run `python -m module arguments` under a name."""
        arguments = tuple(arguments)
        process = self._spawn(name, module, arguments)
        self._programs[name] = _Program(module, arguments, process, time.monotonic())

    def tend(self) -> None:
        """Look at all children, and start those again that are due; called a few times a second."""
        for name, program in list(self._programs.items()):
            code = program.process.poll()
            if code is None:
                continue
            if code in (0, USER_ERROR) or not self._restarts:
                release(self._programs.pop(name).process)
                self._on_end(name, code)
            elif program.due_s is None:
                self._schedule(name, program, code)
            elif time.monotonic() >= program.due_s:
                program.process = self._spawn(name, program.module, program.arguments)
                program.since_s, program.due_s = time.monotonic(), None

    def pids(self) -> list[int]:
        """The process ids of the children."""
        return [program.process.pid for program in self._programs.values()]

    def _spawn(self, name: str, module: str, arguments: Sequence[str]) -> subprocess.Popen:
        with contextlib.ExitStack() as stack:
            log = log_path(self._logs, name) if self._logs else None
            output = stack.enter_context(log.open("wb")) if log else None
            return spawn(module, arguments, output, self.folder)

    def stop(self) -> None:
        """Terminate all children, the newest first; kill those that do not end in time."""
        stop_all([program.process for program in reversed(self._programs.values())], GRACE_S)
        self._programs.clear()

    def _schedule(self, name: str, program: _Program, code: int) -> None:
        release(program.process)
        now_s = time.monotonic()
        if now_s - program.since_s >= STEADY_S:
            program.delay_s = FIRST_DELAY_S
        program.due_s = now_s + program.delay_s
        log.warning("%s ended with code %d; starting it again in %g s", name, code, program.delay_s)
        program.delay_s = min(2 * program.delay_s, LONGEST_DELAY_S)


def log_path(folder: Path, name: str) -> Path:
    """The file to which a supervisor with logs in `folder` writes the output of the child `name`."""
    return folder / f"{re.sub('[^A-Za-z0-9_.-]+', '-', name)}.log"


def spawn(
    module: str, arguments: Sequence[str], output: IO[bytes] | None = None, folder: Path | None = None
) -> subprocess.Popen:
    """Run `python -m module arguments`; it ends with its standard input, and so with this process.

    In a session of its own: Ctrl-C reaches this process only, which then stops its children.

    Args:
        module, arguments: what to run.
        output: for its stdout and stderr; those of this process unless given.
        folder: in which it runs; that of this process unless given.
    """
    return subprocess.Popen(
        [sys.executable, "-P", "-m", "camera_node.foundation.child", module, *arguments],
        cwd=folder,
        stdin=subprocess.PIPE,
        stdout=output,
        stderr=output,
        env=os.environ | ENVIRONMENT,
        start_new_session=True,
    )


def stop_all(processes: Iterable[subprocess.Popen], grace_s: float) -> None:
    """Terminate processes in their order; kill those that do not end within `grace_s`."""
    processes = list(processes)
    for process in processes:
        if process.poll() is None:
            process.terminate()
    deadline_s = time.monotonic() + grace_s
    for process in processes:
        try:
            process.wait(max(0.0, deadline_s - time.monotonic()))
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
        release(process)


def release(process: subprocess.Popen) -> None:
    """Close this process's end of a child's standard input."""
    if process.stdin is not None:
        process.stdin.close()
