# SPDX-License-Identifier: BSD-3-Clause
"""Mutated messages on all keys of a running arena: `python -m tests.benchmarks.fuzz [--messages 1000000] [--seed 1]`.

Server, cameras, viewer, page, recorder and client run as processes and follow ten robots during the run.
"""

import shutil
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import tyro
from rich.table import Table

from camera_node.foundation.terminal import console, say, track
from tests.benchmarks.faults.arena import Fuzz, LiveArena, small_load
from tests.benchmarks.faults.fuzzer import FUZZED
from tests.benchmarks.faults.judge import WrongPose
from tests.benchmarks.faults.memory import Growth
from tests.benchmarks.fusion_load import Load

EXTRA = ("viewer", "page", "recorder", "listener", "rendered")
CAMERAS = 4
SETTLE_S = 3.0  # after the acquisition of all robots
UNDISTURBED_S = 10.0  # of poses before the first fault
MAX_OFFSET_M = 0.002  # by which the largest error may grow
MAX_LINES = 100  # of all logs
FILL_MB = (
    60.0  # by which a program may grow until its caches are full, in a run that is too short for its growth
)
MAX_COMBINATIONS = 8  # of cameras, in the report
CLOSE_S = 2.0  # after the last message, until its effects are over


@dataclass
class FuzzResult:
    """What a run of the fuzzer did to an arena.

    Attributes:
        errors_m: largest error of a tracked pose without faults, and with them.
        by_cameras_m: the largest errors with faults by the cameras that contributed.
        wrong: poses whose error is above the largest without faults by more than `MAX_OFFSET_M`, and above 5 sigma.
        gap_s: the longest gap in the poses of a robot.
        lines: of all logs during the run.
        grown_mb: memory of each program, from the first to the last sample.
        growths: of the memory of the attacked programs after the warm-up; empty after a short run.
        summary: what the fuzzer says that it sent.
    """

    errors_m: tuple[float, float] = (0.0, 0.0)
    rms_m: tuple[float, float] = (0.0, 0.0)
    by_cameras_m: dict[tuple[str, ...], float] = field(default_factory=dict)
    wrong: list[WrongPose] = field(default_factory=list)
    gap_s: float = 0.0
    lines: list[tuple[str, str]] = field(default_factory=list)
    grown_mb: dict[str, float] = field(default_factory=dict)
    growths: dict[str, Growth] = field(default_factory=dict)
    crashes: list[str] = field(default_factory=list)
    faults: dict[str, int] = field(default_factory=dict)
    summary: str = ""

    def failures(self) -> list[str]:
        """What does not hold, one line each."""
        grown = {n: mb for n, mb in self.grown_mb.items() if mb > FILL_MB and n not in self.growths}
        worst = max(self.wrong, key=lambda pose: pose.error_m, default=None)
        return [
            *self.crashes,
            *([f"{len(self.wrong)} poses are wrong, the worst by {worst}"] if worst else []),
            *([f"{len(self.lines)} log lines"] if len(self.lines) >= MAX_LINES else []),
            *(f"{name} grew by {mb:.0f} MB" for name, mb in grown.items()),
            *(f"{name} grows by {growth}" for name, growth in self.growths.items() if growth.is_excessive),
        ]


def fuzz(
    folder: Path, options: Fuzz, extra: tuple[str, ...] = EXTRA, undisturbed_s: float = UNDISTURBED_S
) -> Iterator[int | FuzzResult]:
    """Run an arena and send faults to it; yields the number of sent messages about once a second, then the result."""
    load = small_load(cameras=CAMERAS)
    arena = LiveArena(folder, load, extra)
    arena.fuzz = options
    arena.rig[FUZZED] = Load(cameras=CAMERAS + 1).rig[f"cam{CAMERAS}"]
    result = FuzzResult()
    with arena:
        arena.wait_until_tracked()
        arena.wait(SETTLE_S)
        arena.judge.forget()
        arena.wait(undisturbed_s)
        before = arena.judge.largest_m, arena.judge.rms_m
        arena.programs.new_lines()
        arena.programs.sample_memory()
        first = {name: arena.programs.memory_mb(name) for name in arena.programs.names}
        arena.judge.forget()
        arena.judge.max_error_m = before[0] + MAX_OFFSET_M
        arena.start("fuzzer")
        while (code := arena.programs.exit_code("fuzzer", 1.0)) is None:
            arena.programs.sample_memory()
            arena.programs.check()
            yield sent(folder)
        arena.wait(CLOSE_S)
        arena.judge.close_gaps()
        result.crashes += [f"fuzzer: exit code {code}"] if code else []
        result.errors_m, result.rms_m = (before[0], arena.judge.largest_m), (before[1], arena.judge.rms_m)
        result.by_cameras_m = dict(arena.judge.largest_by_cameras_m)
        result.wrong = list(arena.judge.wrong)
        result.gap_s = max((gap.seconds for gap in arena.judge.gaps), default=0.0)
        result.lines += arena.programs.new_lines()
        result.grown_mb = {n: arena.programs.memory_mb(n) - mb for n, mb in first.items()}
        result.faults = dict(arena.status.faults) if arena.status else {}
    result.crashes += arena.programs.crashes
    result.growths = {name: growth for name, growth in arena.programs.growths().items() if name != "fuzzer"}
    arena.programs.save_memory(folder / "memory.txt")
    result.summary = (folder / "fuzzer.out").read_text()
    yield result


def sent(folder: Path) -> int:
    """The number of messages that the fuzzer has sent, by its own report."""
    words = (folder / "fuzzer.out").read_text().split()
    return int(words[-1]) if words and words[-1].isdecimal() else 0


def main(messages: int = 1_000_000, seed: int = 1, rate: float = 2000.0, only: str = "") -> int:
    """Print what was sent and what it did; exit code 1 if something does not hold.

    Args:
        messages: how many.
        seed: of the choices.
        rate: messages a second.
        only: part of the name of a target of `Fuzzer`; all unless given.
    """
    result = FuzzResult()
    folder = Path(tempfile.mkdtemp(prefix="roundel-fuzz-"))
    steps = fuzz(folder, Fuzz(messages, rate, seed, only))
    for step in track(steps, "fuzzing", messages / rate):
        if isinstance(step, FuzzResult):
            result = step
    report(result)
    if result.failures():
        say(f"logs of the programs: {folder}")
        return 1
    shutil.rmtree(folder)
    return 0


def report(result: FuzzResult) -> None:
    """Print the result."""
    table = Table("program", "grew by MB", "growth after the warm-up", "log lines")
    for name, mb in result.grown_mb.items():
        lines = sum(program == name for program, _ in result.lines)
        table.add_row(name, f"{mb:.1f}", str(result.growths.get(name, "")), str(lines))
    console().print(table)
    for line in result.summary.splitlines()[-15:]:
        say(line)
    for name, line in result.lines[:MAX_LINES]:
        say(f"{name}: {line[:200]}")
    errors, rms = ([1e3 * value for value in pair] for pair in (result.errors_m, result.rms_m))
    say(
        f"error before: {errors[0]:.2f} mm (RMS {rms[0]:.2f}), with faults: {errors[1]:.2f} mm (RMS {rms[1]:.2f})"
    )
    for cameras, error_m in sorted(result.by_cameras_m.items(), key=lambda pair: -pair[1])[:MAX_COMBINATIONS]:
        say(f"largest error with {' '.join(cameras) or 'no camera'}: {1e3 * error_m:.2f} mm")
    say(
        f"longest gap: {result.gap_s:.2f} s; {len(result.lines)} log lines; counted by the server: {result.faults}"
    )
    for failure in result.failures():
        say(f"FAILED {failure}")


if __name__ == "__main__":
    raise SystemExit(tyro.cli(main))
