# SPDX-License-Identifier: BSD-3-Clause
"""Clocks of cameras that jump or drift: `python -m tests.benchmarks.clocks [--thorough]`.

A pose is wrong if it is "tracked" and off by more than 10 mm and 5 sigma, 0.1 s after the fault or later.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import tyro
from rich.console import Console
from rich.table import Table

from tests.benchmarks.fusion_load import Load
from tests.fusion.clock_faults import GRACE_S, JITTER_S, Outcome, StampError, drift, fuse, step

FAULT_S = 3.0
LOAD = Load(robots=4, cameras=4, hz=30.0, speed_m_s=1.0, crossing=True)
STEPS_MS = (10, -25, 25, 50, 500, -500, 1000, -1000)


@dataclass(frozen=True)
class Case:
    """A load, and the faults of its cameras; `jitter_s` None is a recording without arrival times."""

    what: str
    load: Load
    faults: dict[str, StampError]
    seconds: float = 8.0
    jitter_s: float | None = JITTER_S


def main(thorough: bool = False) -> None:
    """Print the table.

    Args:
        thorough: all motions with all steps, and drifts of several minutes; takes an hour.
    """
    columns = "fault", "wrong poses", "worst mm", "tracked", "reported s", "again in use s", "others", "moves"
    table = Table(*columns, title="clocks of cameras; times since the fault")
    for case in _cases(thorough):
        table.add_row(*_row(case, fuse(case.load, case.seconds, case.faults, case.jitter_s)))
    Console(width=150).print(table)


def _row(case: Case, outcome: Outcome) -> tuple[str, ...]:
    named = {name for name in case.load.rig if np.isfinite(outcome.reported_s(name))}
    return (
        case.what,
        str(len(outcome.wrong(FAULT_S + GRACE_S))),
        f"{1e3 * outcome.worst_m(FAULT_S + GRACE_S):.1f}",
        f"{100 * outcome.tracked(FAULT_S):.1f} %",
        " ".join(f"{outcome.reported_s(name) - FAULT_S:.2f}" for name in case.faults),
        " ".join(_again_in_use(outcome.in_use_since_s(name)) for name in case.faults),
        " ".join(sorted(named - case.faults.keys())) or "none",
        str(len(outcome.moves)),
    )


def _again_in_use(since_s: float) -> str:
    """When a camera's detections were used again after the fault; without a gap above 0.3 s they always were."""
    return "no gap" if since_s < FAULT_S else f"{since_s - FAULT_S:.2f}"


def _cases(thorough: bool) -> Iterator[Case]:
    yield Case("none, 60 s", LOAD, {}, 300.0 if thorough else 60.0)
    for ms in STEPS_MS:
        yield Case(f"step {ms} ms", LOAD, {"cam1": step(FAULT_S, ms * 1e-3)})
    for first, second in ((10, 10), (25, -50), (500, 500), (1000, 25)):
        faults = {"cam1": step(FAULT_S, first * 1e-3), "cam2": step(FAULT_S, second * 1e-3)}
        yield Case(f"steps {first} and {second} ms of 4 cameras", LOAD, faults)
    for ms in (10, 25, -25, 50):
        faults = {"cam1": step(FAULT_S, ms * 1e-3)}
        yield Case(f"step {ms} ms, no arrival times", LOAD, faults, jitter_s=None)
    for speed in (0.0, 0.05, 0.2, 2.0):
        for ms in (*STEPS_MS,) if thorough else (25,):
            load = replace(LOAD, speed_m_s=speed)
            yield Case(f"step {ms} ms at {speed:g} m/s", load, {"cam1": step(FAULT_S, ms * 1e-3)})
    eight = replace(LOAD, cameras=8, hz=60.0)
    yield Case("step 25 ms of 8 cameras at 60 Hz", eight, {"cam1": step(FAULT_S, 0.025)}, 6.0)
    half = {f"cam{k}": step(FAULT_S, 0.025) for k in (0, 2)}
    yield Case("step 25 ms of half of the cameras", LOAD, half)
    for ppm in (200.0, -200.0, 50.0):
        seconds = 180.0 if thorough else 45.0
        yield Case(f"drift {ppm:g} ppm", LOAD, {"cam1": drift(FAULT_S, ppm)}, seconds)


if __name__ == "__main__":
    tyro.cli(main)
