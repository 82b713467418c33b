# SPDX-License-Identifier: BSD-3-Clause
"""Clocks that jump or drift, of cameras and of the server: `python -m tests.benchmarks.clocks [--thorough]`.

A pose is wrong if it is "tracked" and off by more than 10 mm and 5 sigma, 0.1 s after the fault or later. The camera
must be reported within 1 s of a step, or before a drift displaces robots by 2.5 mm; it is used again within 5 s; no
other camera is reported, and no pose of a camera changes. Rows marked "live" run programs in real time.
"""

import tempfile
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import tyro
from rich.table import Table

from camera_node.foundation.terminal import console, say, track
from tests.benchmarks.faults.arena import small_load
from tests.benchmarks.faults.live_clocks import Judged, drift_live, set_system_clock
from tests.benchmarks.fusion_load import Load
from tests.fusion.clock_faults import GRACE_S, JITTER_S, Outcome, StampError, drift, fuse, step

FAULT_S = 3.0
LOAD = Load(robots=4, cameras=4, hz=30.0, speed_m_s=1.0, crossing=True)
STEPS_MS = (10, -10, 25, -25, 50, -50, 500, -500, 1000, -1000)
REPORT_S, USE_S = 1.0, 5.0  # after a step: the camera is reported, and used again
REPORT_DRIFT_M = 0.0025  # a drift is reported before it displaces robots at their speed by this
COLUMNS = (
    "fault",
    "wrong poses",
    "worst mm",
    "tracked",
    "reported s",
    "again in use s",
    "others",
    "moves",
    "holds",
)


@dataclass(frozen=True)
class Case:
    """A load, and the faults of its cameras; `jitter_s` None is a recording without arrival times.

    `report_s` is how long the report may take; None for faults that need not be found.
    """

    what: str
    load: Load
    faults: dict[str, StampError]
    seconds: float = 8.0
    jitter_s: float | None = JITTER_S
    report_s: float | None = REPORT_S


def main(thorough: bool = False, live: bool = True, jitter_ms: float = 1e3 * JITTER_S, only: str = "") -> int:
    """Print the table; exit code 1 if something does not hold.

    Args:
        thorough: all motions with all steps, and drifts of several minutes; takes an hour.
        live: the rows between programs too, a minute.
        jitter_ms: mean of the varying part of the time from exposure to arrival.
        only: rows whose names contain this.
    """
    cases = [_with_jitter(case, jitter_ms * 1e-3) for case in _cases(thorough) if only in case.what]
    rows = [_row(case) for case in track(cases, "clocks")]
    rows += _live_rows() if live else []
    table = Table(*COLUMNS, title="clocks; times since the fault")
    for row in rows:
        table.add_row(*row)
    console().print(table)
    n_failures = sum(row[-1] != "yes" for row in rows)
    say(f"{n_failures} of {len(rows)} rows do not hold" if n_failures else "all holds")
    return int(n_failures > 0)


def _with_jitter(case: Case, jitter_s: float) -> Case:
    return case if case.jitter_s is None else replace(case, jitter_s=jitter_s)


def _row(case: Case) -> tuple[str, ...]:
    outcome = fuse(case.load, case.seconds, case.faults, case.jitter_s)
    return (
        case.what,
        str(len(outcome.wrong(FAULT_S + GRACE_S))),
        f"{1e3 * outcome.worst_m(FAULT_S + GRACE_S):.1f}",
        f"{100 * outcome.tracked(FAULT_S):.1f} %",
        " ".join(f"{outcome.reported_s(name) - FAULT_S:.2f}" for name in case.faults),
        " ".join(_again_in_use(outcome.in_use_since_s(name)) for name in case.faults),
        " ".join(_others(case, outcome)) or "none",
        str(len(outcome.moves)),
        ", ".join(_failures(case, outcome)) or "yes",
    )


def _others(case: Case, outcome: Outcome) -> list[str]:
    """Cameras without a fault that are reported."""
    return sorted(n for n in case.load.rig if n not in case.faults and np.isfinite(outcome.reported_s(n)))


def _failures(case: Case, outcome: Outcome) -> Iterator[str]:
    if outcome.wrong(FAULT_S + GRACE_S):
        yield "wrong poses"
    if outcome.moves:
        yield "moves"
    if case.report_s is None:
        return
    if _others(case, outcome):
        yield "others"
    if any(outcome.reported_s(name) > FAULT_S + case.report_s for name in case.faults):
        yield "report"
    if any(outcome.in_use_since_s(name) > FAULT_S + USE_S for name in case.faults):
        yield "use"


def _again_in_use(since_s: float) -> str:
    """When a camera's detections were used again after the fault; without a gap above 0.3 s they always were."""
    return "no gap" if since_s < FAULT_S else f"{since_s - FAULT_S:.2f}"


def _cases(thorough: bool) -> Iterator[Case]:
    yield Case("none, 60 s", LOAD, {}, 300.0 if thorough else 60.0)
    for ms in STEPS_MS:
        yield Case(f"step {ms} ms", LOAD, {"cam1": step(FAULT_S, ms * 1e-3)})
    for first, second in ((10, 10), (25, -50), (50, 50), (500, 500), (1000, 25)):
        faults = {"cam1": step(FAULT_S, first * 1e-3), "cam2": step(FAULT_S, second * 1e-3)}
        yield Case(f"steps {first} and {second} ms of 4 cameras", LOAD, faults)
    for ppm in (200.0, -200.0, 50.0):
        limit_s = REPORT_DRIFT_M / (LOAD.speed_m_s * abs(ppm * 1e-6))
        seconds = 180.0 if thorough else FAULT_S + limit_s + USE_S
        yield Case(f"drift {ppm:g} ppm", LOAD, {"cam1": drift(FAULT_S, ppm)}, seconds, report_s=limit_s)
    yield from _harder_cases(thorough)


def _harder_cases(thorough: bool) -> Iterator[Case]:
    """Without arrival times, at other speeds, of many cameras: wrong poses count, reports do not."""
    for ms in (10, 25, -25, 50):
        faults = {"cam1": step(FAULT_S, ms * 1e-3)}
        yield Case(f"step {ms} ms, no arrival times", LOAD, faults, jitter_s=None, report_s=None)
    for speed in (0.0, 0.05, 0.2, 2.0):
        for ms in (*STEPS_MS,) if thorough else (25,):
            load = replace(LOAD, speed_m_s=speed)
            faults = {"cam1": step(FAULT_S, ms * 1e-3)}
            yield Case(f"step {ms} ms at {speed:g} m/s", load, faults, report_s=None)
    eight = replace(LOAD, cameras=8, hz=60.0)
    yield Case("step 25 ms of 8 cameras at 60 Hz", eight, {"cam1": step(FAULT_S, 0.025)}, 6.0, report_s=None)
    half = {f"cam{k}": step(FAULT_S, 0.025) for k in (0, 2)}
    yield Case("step 25 ms of half of the cameras", LOAD, half, report_s=None)


def _live_rows() -> Iterator[tuple[str, ...]]:
    ahead_ms = tuple(sign * ms for ms in (10, 25, 50, 500, 1000) for sign in (1, -1))
    with tempfile.TemporaryDirectory(prefix="roundel-clocks-") as folder:
        judged = set_system_clock(Path(folder), tuple(ms * 1e-3 for ms in ahead_ms))
    for ms, of_step in zip(ahead_ms, judged, strict=True):
        yield *_live_row(f"live: system clock {ms:+d} ms", of_step), "", "", "", "", _held(of_step)
    with tempfile.TemporaryDirectory(prefix="roundel-clocks-") as folder:
        drifted = drift_live(Path(folder), 200.0)
    displaced_m = drifted.reported_s * 200e-6 * small_load().speed_m_s
    late = displaced_m > REPORT_DRIFT_M or drifted.recovered_s > USE_S or drifted.others
    yield (
        *_live_row(f"live: drift 200 ppm, then a step of {-drifted.step_ms:.1f} ms", drifted.judged),
        f"{drifted.reported_s:.2f}",
        f"{drifted.recovered_s:.2f}",
        " ".join(drifted.others) or "none",
        "",
        "report or use" if late else _held(drifted.judged),
    )


def _live_row(what: str, judged: Judged) -> tuple[str, ...]:
    return what, str(judged.wrong), f"{1e3 * judged.worst_m:.1f}", f"{100 * judged.share:.1f} %"


def _held(judged: Judged) -> str:
    return "wrong poses" if judged.wrong else "yes"


if __name__ == "__main__":
    raise SystemExit(tyro.cli(main))
