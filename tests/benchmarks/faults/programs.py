# SPDX-License-Identifier: BSD-3-Clause
"""Starts real programs, ends and pauses them by signals, and reads their logs and their memory."""

import contextlib
import os
import signal
import subprocess
import sys
import time
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from camera_node.foundation.arrays import Array
from tests.benchmarks.faults.memory import Growth, anonymous_mb, growth

END_S = 10.0  # within which a program ends after SIGTERM


@dataclass
class Program:
    """A running program: its process, since when it runs, and its anonymous memory over time (age s, MB).

    `ends` is whether it ends by itself, which `Programs.exit_code` awaits.
    """

    process: subprocess.Popen
    ends: bool = False
    started_s: float = field(default_factory=time.monotonic)
    memory: list[tuple[float, float]] = field(default_factory=list)


class Programs:
    """Child processes by name; each appends to `<folder>/<name>.log` (stderr) and `<name>.out` (stdout).

    Attributes:
        crashes: programs that ended by themselves, with their exit codes.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.crashes: list[str] = []
        self._lives: dict[str, list[Array]] = defaultdict(list)  # memory of the programs that ended
        self._running: dict[str, Program] = {}
        self._read: dict[str, int] = defaultdict(int)  # bytes of each log

    def __enter__(self) -> "Programs":
        return self

    def __exit__(self, *exception: object) -> None:
        for name in tuple(self._running):
            self.pause(name, False)
            self._running[name].process.terminate()
        for name in tuple(self._running):
            self._forget(name, 0)

    @property
    def names(self) -> tuple[str, ...]:
        """Of the programs that were started and not ended."""
        return tuple(self._running)

    def start(self, name: str, command: Sequence[str], ends: bool = False) -> None:
        """Run a command; `ends` if it is expected to end by itself."""
        environment = os.environ | {
            "OPENBLAS_NUM_THREADS": "1",
            "OMP_NUM_THREADS": "1",
            "PYTHONUNBUFFERED": "1",
        }
        with (self.folder / f"{name}.log").open("ab") as log, (self.folder / f"{name}.out").open("wb") as out:
            process = subprocess.Popen(
                command,
                stdin=subprocess.PIPE,
                stdout=out,
                stderr=log,
                env=environment,
                start_new_session=True,
            )
        self._running[name] = Program(process, ends)

    def is_running(self, name: str) -> bool:
        return name in self._running and self._running[name].process.poll() is None

    def pid(self, name: str) -> int:
        return self._running[name].process.pid

    def write(self, name: str, line: bytes) -> None:
        """Write a line to a program's standard input; without effect if it has ended."""
        pipe = self._running[name].process.stdin if self.is_running(name) else None
        if pipe is not None:
            pipe.write(line + b"\n")
            pipe.flush()

    def pause(self, name: str, paused: bool) -> None:
        """SIGSTOP or SIGCONT."""
        self._running[name].process.send_signal(signal.SIGSTOP if paused else signal.SIGCONT)

    def kill(self, name: str) -> None:
        """SIGKILL."""
        self._forget(name, signal.SIGKILL)

    def end(self, name: str) -> None:
        """SIGTERM; SIGKILL if that has no effect, which counts as a crash."""
        self._forget(name, signal.SIGTERM)

    def exit_code(self, name: str, timeout_s: float) -> int | None:
        """The code with which a program ends by itself; None if it does not. It is forgotten then."""
        try:
            code = self._running[name].process.wait(timeout_s)
        except subprocess.TimeoutExpired:
            return None
        self._forget(name, 0)
        return code

    def check(self) -> None:
        """Move programs that ended by themselves to `crashes`."""
        for name, program in tuple(self._running.items()):
            if not program.ends and (code := program.process.poll()) is not None:
                self.crashes.append(f"{name}: exit code {code}")
                self._forget(name, 0)

    def sample_memory(self) -> None:
        """Note the anonymous memory of all programs."""
        for program in self._running.values():
            with contextlib.suppress(OSError, StopIteration):  # it is over
                memory_mb = anonymous_mb(program.process.pid)
                program.memory.append((time.monotonic() - program.started_s, memory_mb))

    def growths(self) -> dict[str, Growth]:
        """The growth of the memory of each program that ran for long enough, by name."""
        lives = {name: list(ended) for name, ended in self._lives.items()}
        for name, program in self._running.items():
            lives.setdefault(name, []).append(np.array(program.memory))
        measured = {name: growth(of_name) for name, of_name in lives.items()}
        return {name: result for name, result in measured.items() if result is not None}

    def save_memory(self, path: Path) -> None:
        """Write the samples of all programs that ended: name, number of the life, age in seconds, MB."""
        rows = [
            f"{name} {k} {age_s:.0f} {memory_mb:.2f}\n"
            for name, lives in self._lives.items()
            for k, samples in enumerate(lives)
            for age_s, memory_mb in samples.reshape(-1, 2)
        ]
        path.write_text("".join(rows))

    def memory_mb(self, name: str) -> float:
        """Of the last sample; 0 without one."""
        memory = self._running[name].memory if name in self._running else []
        return memory[-1][1] if memory else 0.0

    def waited_s(self) -> dict[str, float]:
        """For how long each thread of the programs has waited for a processor so far, by the kernel's account."""
        waits = {}
        for program in tuple(self._running.values()):
            for path in Path(f"/proc/{program.process.pid}/task").glob("*/schedstat"):
                with contextlib.suppress(OSError, IndexError):
                    waits[str(path)] = int(path.read_text().split()[1]) * 1e-9
        return waits

    def new_lines(self) -> list[tuple[str, str]]:
        """The complete lines that the programs logged since the last call, with the programs' names."""
        lines = []
        for path in self.folder.glob("*.log"):
            with path.open("rb") as file:
                file.seek(self._read[path.name])
                data = file.read()
            complete = data[: data.rfind(b"\n") + 1]
            self._read[path.name] += len(complete)
            lines += [(path.stem, line) for line in complete.decode(errors="replace").splitlines()]
        return lines

    def _forget(self, name: str, number: int) -> None:
        """Wait for the end of a program, after a signal unless `number` is 0."""
        program = self._running.pop(name)
        process = program.process
        if number:
            process.send_signal(signal.SIGCONT)
            process.send_signal(number)
        try:
            process.wait(END_S)
        except subprocess.TimeoutExpired:
            self.crashes.append(f"{name}: did not end within {END_S:g} s")
            process.kill()
            process.wait()
        if process.stdin is not None:
            process.stdin.close()
        self._lives[name].append(np.array(program.memory))


def python(module: str, *arguments: object) -> list[str]:
    """The command line of a module."""
    return [sys.executable, "-m", module, *map(str, arguments)]
