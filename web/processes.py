# SPDX-License-Identifier: BSD-3-Clause
"""The programs of an arena as child processes: started together, watched, and never left behind."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import FrameType

import psutil

from web.errors import WebError

GRACE_S = 5.0  # to end after being asked to; then a child is killed
TAIL_LINES = 8


class ProgramFailed(Exception):
    """A child stopped that should not have; the message shows what it said last."""


class Processes:
    """Children by name, each writing to `<folder>/<name>.log`. Leaving the `with` block stops all of them."""

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
        """Run `python -m module arguments`."""
        command = [sys.executable, "-m", module, *arguments]
        # One thread a program: on few cores, those of linear algebra libraries only take time from the cameras.
        environment = os.environ | {
            "PYTHONUNBUFFERED": "1",
            "OMP_NUM_THREADS": "1",
            "OPENBLAS_NUM_THREADS": "1",
        }
        with self._log(name).open("wb") as log:
            # In a session of its own, so that Ctrl-C reaches this program alone, which then stops the others in order.
            child = subprocess.Popen(
                command,
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
                env=environment,
                start_new_session=True,
            )
        self._children[name] = child
        self._meters[name] = psutil.Process(child.pid)

    def finished(self, name: str) -> bool:
        """Whether the child ended well.

        Raises:
            WebError, ProgramFailed: it ended otherwise.
        """
        code = self._children[name].poll()
        if code:
            self._raise_failed(name, code)
        return code == 0

    def check(self, *expected_to_end: str) -> None:
        """Raise unless all children run; those that are expected to end may have ended well.

        Raises:
            WebError: a child ended because of something that a person can mend; its own line says what.
            ProgramFailed: it ended in another way.
        """
        for name in self._children:
            if self.finished(name) and name not in expected_to_end:
                self._raise_failed(name, 0)

    def stop(self) -> None:
        """Ask all children to end, the newest first; kill those that don't."""
        for child in reversed(self._children.values()):
            if child.poll() is None:
                child.terminate()
        deadline = time.monotonic() + GRACE_S
        for child in self._children.values():
            try:
                child.wait(max(0.0, deadline - time.monotonic()))
            except subprocess.TimeoutExpired:
                child.kill()
                child.wait()
        self._children.clear()

    def pids(self) -> list[int]:
        """The children's process numbers."""
        return [child.pid for child in self._children.values()]

    def processor_seconds(self) -> float:
        """Processor time that the running children and this process have used so far; notes the memory's peak."""
        seconds, resident = 0.0, 0
        for meter in (*self._meters.values(), psutil.Process()):
            try:
                with meter.oneshot():
                    times = meter.cpu_times()
                    seconds += times.user + times.system
                    resident += meter.memory_info().rss
            except psutil.Error:  # it has ended
                continue
        self.peak_bytes = max(self.peak_bytes, resident)
        return seconds

    def _raise_failed(self, name: str, code: int) -> None:
        lines = self._log(name).read_text(errors="replace").strip().splitlines()
        if code == 2 and lines and lines[-1].startswith("error: "):
            raise WebError(f"{name}: {lines[-1].removeprefix('error: ')}")
        said = "\n".join(f"  {line}" for line in lines[-TAIL_LINES:])
        raise ProgramFailed(f"{name} stopped with code {code}; its log is {self._log(name)}\n{said}".rstrip())

    def _log(self, name: str) -> Path:
        return self.folder / f"{name}.log"


@contextmanager
def ended_by_signals() -> Iterator[None]:
    """Make a closed terminal and a request to end raise KeyboardInterrupt, so that `with` blocks are left in order."""

    def interrupt(number: int, frame: FrameType | None) -> None:
        raise KeyboardInterrupt

    numbers = [signal.SIGINT, signal.SIGTERM, signal.SIGHUP]
    before = [signal.signal(number, interrupt) for number in numbers]
    try:
        yield
    finally:
        for number, handler in zip(numbers, before, strict=True):
            signal.signal(number, handler)
