# SPDX-License-Identifier: BSD-3-Clause
"""Cameras that lag, jitter, stall, have other rates or bad stamps, in virtual time: `python -m
tests.benchmarks.conditions`.

None of these is a fault: labs have them all the time. For each, the table has how many of the expected poses came,
their errors, and whom the server blamed.
"""

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro
from rich.table import Table

from camera_node.foundation.terminal import console, track
from tests.benchmarks.faults.arena import small_load
from tests.benchmarks.faults.virtual_arena import TRANSIT_S, VirtualArena
from tests.benchmarks.faults.world import CameraFault

BEGIN_S = 3.0  # until all robots are tracked
STALLS = 0.02  # share of the frames that stall
ONE, ALL = ("cam1",), ("cam0", "cam1", "cam2", "cam3")


@dataclass(frozen=True)
class Condition:
    """What some cameras are like all the time.

    Attributes:
        cameras: which ones.
        lag_ms: constant delay of their frames.
        jitter_ms: mean of an exponential delay more.
        stall_ms: one more delay of `STALLS` of the frames, behind which those after them wait.
        hz: rate; None for 30.
        stamp_ms: standard deviation of their stamps, which nothing declares.
    """

    cameras: Sequence[str] = ONE
    lag_ms: float = 0.0
    jitter_ms: float = 0.0
    stall_ms: float = 0.0
    hz: float | None = None
    stamp_ms: float = 0.0


CONDITIONS: dict[str, tuple[Condition, ...]] = {
    "as they should be": (),
    "one lags by 180 ms": (Condition(lag_ms=180.0),),
    "one lags by 250 ms": (Condition(lag_ms=250.0),),
    "lags of 0, 100, 200, 300 ms": tuple(Condition((f"cam{k}",), lag_ms=100.0 * k) for k in range(4)),
    "all lag by 250 ms": (Condition(ALL, lag_ms=250.0),),
    "all lag by 400 ms": (Condition(ALL, lag_ms=400.0),),
    "jitter of 80 ms of one": (Condition(jitter_ms=80.0),),
    "jitter of 80 ms of all": (Condition(ALL, jitter_ms=80.0),),
    "stalls of 400 ms of one": (Condition(stall_ms=400.0),),
    "stalls of 400 ms of all": (Condition(ALL, stall_ms=400.0),),
    "one at 15 Hz": (Condition(hz=15.0),),
    "one at 29.97 Hz": (Condition(hz=29.97),),
    "one at 60 Hz": (Condition(hz=60.0),),
    "30, 25, 15 and 50 Hz": tuple(
        Condition((f"cam{k}",), hz=hz) for k, hz in enumerate((30.0, 25.0, 15.0, 50.0))
    ),
    "all at 10 Hz": (Condition(ALL, hz=10.0),),
    "all at 5 Hz": (Condition(ALL, hz=5.0),),
    "stamps of one to 3 ms": (Condition(stamp_ms=3.0),),
    "stamps of all to 3 ms": (Condition(ALL, stamp_ms=3.0),),
}


class ConditionedArena(VirtualArena):
    """An arena whose cameras have conditions."""

    def __init__(self, folder: Path, conditions: Sequence[Condition], judging_s: float) -> None:
        super().__init__(folder, small_load(), judging_s=judging_s)
        self._of = {name: condition for condition in conditions for name in condition.cameras}
        for name, condition in self._of.items():
            source = self.sources[name]
            source.hz = condition.hz or source.hz
            source.stamp_sigma_ns += round(condition.stamp_ms * 1e6)
            self.place(name, CameraFault(delay_ms=condition.lag_ms))

    def transit_s(self, name: str, rng: np.random.Generator) -> float:
        """As an arena's, and the delays that vary."""
        condition = self._of.get(name, Condition())
        stall_ms = condition.stall_ms if rng.random() < STALLS else 0.0
        return 1e-3 * stall_ms + rng.exponential(TRANSIT_S + 1e-3 * condition.jitter_ms)


def measure(conditions: Sequence[Condition], seconds: float, judging_s: float) -> list[str]:
    """The columns of one line of the table."""
    with tempfile.TemporaryDirectory() as folder:
        arena = ConditionedArena(Path(folder), conditions, judging_s)
        with arena:
            arena.wait(BEGIN_S)
            arena.judge.forget()
            arena.new_lines()
            arena.wait(seconds)
            arena.judge.close_gaps()
            judge, pipeline = arena.judge, arena.server.pipeline
            blamed = sorted({line for _, line in arena.new_lines() if "late" not in line})
            expected = (pipeline.synchronizer.rate_hz or 0.0) * seconds * arena.load.robots
            return [
                f"{judge.count / max(1.0, expected):.1%}",
                f"{1e3 * judge.rms_m:.2f}",
                f"{1e3 * judge.largest_m:.1f}",
                str(len(judge.wrong)),
                f"{max((gap.seconds for gap in judge.gaps), default=0.0):.2f}",
                str(sum(pipeline.synchronizer.late.values())),
                "; ".join(line[:60] for line in blamed[:2]),
            ]


def main(seconds: float = 12.0, judging_s: float = 0.4, only: tuple[str, ...] = ()) -> None:
    """Print the table.

    Args:
        seconds: of each condition, in virtual time.
        judging_s: how long a judgement of the cameras takes, as on a busy machine.
        only: names of conditions; all unless given.
    """
    table = Table(
        "condition", "poses", "RMS mm", "max mm", "wrong", "longest gap s", "late", "the server said"
    )
    chosen = {name: of for name, of in CONDITIONS.items() if not only or name in only}
    for name, conditions in track(chosen.items(), "conditions"):
        table.add_row(name, *measure(conditions, seconds, judging_s))
    console().print(table)


if __name__ == "__main__":
    tyro.cli(main)
