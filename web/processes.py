# SPDX-License-Identifier: BSD-3-Clause
"""Starts, watches and stops the programs of an arena as child processes."""

import signal
import subprocess
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import FrameType

import psutil

from camera_node.errors import TEMPORARY_FAILURE, USER_ERROR
from camera_node.supervisor import release, spawn, stop_all
from web.errors import WebError

GRACE_S = 5.0  # between SIGTERM and SIGKILL
TAIL_LINES = 8  # of a log, that the message of a failure quotes


class ProgramFailed(Exception):
    """A child stopped unexpectedly; the message quotes the end of its log."""


class Processes:
    """Children by name; each writes to `<folder>/<name>.log`. Leaving the `with` block stops all of them."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._children: dict[str, subprocess.Popen] = {}
        self._meters: dict[str, psutil.Process] = {}
        self.peak_bytes = 0

    def __enter__(self) -> "Processes":
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()

    def start(self, name: str, module: str, arguments: Sequence[str]) -> None:
        """Run `python -m module arguments` until it ends, `stop` is called or this process ends, by whatever cause."""
        with self._log(name).open("wb") as log:
            child = spawn(module, arguments, log)
        if name in self._children:
            release(self._children[name])
        self._children[name] = child
        self._meters[name] = psutil.Process(child.pid)

    def finished(self, name: str) -> bool:
        """Whether the child ended with exit code 0.

        Raises:
            WebError: it ended with one line on a fault that the user can correct.
            ProgramFailed: it ended with another exit code.
        """
        code = self._children[name].poll()
        if code:
            self._raise_failed(name, code)
        return code == 0

    def check(self, *expected_to_end: str) -> None:
        """Raise unless all children run; those that are expected to end may have ended with exit code 0.

        Raises:
            WebError, ProgramFailed: as `finished`; a child that ended unexpectedly raises ProgramFailed.
        """
        for name in self._children:
            if self.finished(name) and name not in expected_to_end:
                self._raise_failed(name, 0)

    def stop(self) -> None:
        """Terminate all children, the newest first; kill those that do not end within `GRACE_S`."""
        stop_all(reversed(self._children.values()), GRACE_S)
        self._children.clear()

    def pids(self) -> list[int]:
        """Return the process ids of the children."""
        return [child.pid for child in self._children.values()]

    def measure(self) -> float:
        """Update `peak_bytes`; return the processor time of this process and the running children, seconds."""
        seconds, resident = 0.0, 0
        for meter in (*self._meters.values(), psutil.Process()):
            try:
                with meter.oneshot():
                    times = meter.cpu_times()
                    seconds += times.user + times.system
                    resident += meter.memory_info().rss
            except psutil.Error:  # the child has ended
                continue
        self.peak_bytes = max(self.peak_bytes, resident)
        return seconds

    def _raise_failed(self, name: str, code: int) -> None:
        lines = self._log(name).read_text(errors="replace").strip().splitlines()
        if code in (USER_ERROR, TEMPORARY_FAILURE) and lines and lines[-1].startswith("error: "):
            raise WebError(f"{name}: {lines[-1].removeprefix('error: ')}")
        tail = "\n".join(f"  {line}" for line in lines[-TAIL_LINES:])
        raise ProgramFailed(f"{name} stopped with code {code}; its log is {self._log(name)}\n{tail}".rstrip())

    def _log(self, name: str) -> Path:
        return self.folder / f"{name}.log"


@contextmanager
def interrupt_on_signals() -> Iterator[None]:
    """Raise KeyboardInterrupt on SIGINT, SIGTERM and SIGHUP, so that `with` blocks clean up."""

    def interrupt(number: int, frame: FrameType | None) -> None:
        raise KeyboardInterrupt

    numbers = [signal.SIGINT, signal.SIGTERM, signal.SIGHUP]
    before = [signal.signal(number, interrupt) for number in numbers]
    try:
        yield
    finally:
        for number, handler in zip(numbers, before, strict=True):
            signal.signal(number, handler)
