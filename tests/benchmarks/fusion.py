# SPDX-License-Identifier: BSD-3-Clause
"""Fusion compared with its goals: `python -m tests.benchmarks.fusion [--thorough]`, one core, processor time.

Times depend on the machine and its load; compare figures of one run only.
"""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import tyro
from rich.console import Console
from rich.table import Table

from tests.benchmarks.fusion_accuracy import accuracy
from tests.benchmarks.fusion_capacity import Capacity, capacity, compare
from tests.benchmarks.fusion_grouping import cold_grouping
from tests.benchmarks.fusion_load import Load
from tests.benchmarks.fusion_swaps import identity

Row = tuple[str, str, str, str]
FULL = Load(robots=50, markers=4, cameras=8, hz=60.0)
MIDDLE = Load(robots=20, markers=4, cameras=4, hz=30.0)
FACTORS = {
    "robots": (10, 20, 40),
    "markers": (3, 4, 6),
    "cameras": (2, 4, 8),
    "hz": (15.0, 30.0, 60.0),
    "false": (0.0, 1.0, 8.0),
    "clutter": (0, 10, 30),
}


def main(thorough: bool = False) -> None:
    """Print the table.

    Args:
        thorough: more seeds, longer runs, ten minutes of crossing robots; takes an hour.
    """
    table = Table("what", "measured", "goal", "", title="fusion, on one core")
    console = Console(width=150)
    for row in (
        *_accuracies(thorough),
        *_capacities(thorough),
        *_groupings(thorough),
        *_identities(thorough),
    ):
        table.add_row(*row)
    console.print(table)
    console.print(_growth(10.0 if thorough else 3.0))


def _accuracies(thorough: bool) -> Iterator[Row]:
    seconds = 10.0 if thorough else 1.5
    for speed in (0.0, 1.0, 2.0):
        load = Load(robots=8, speed_m_s=speed, crossing=True)
        free, together = accuracy(load, seconds), accuracy(replace(load, synchronised=True), seconds)
        what = f"8 robots at {speed:g} m/s, free-running"
        yield (
            f"{what}: RMS, and by the bound",
            f"{free.tracker_mm:.3f} mm, {free.tracker_mm / free.bound_mm:.2f} times",
            "1.15 times",
            _verdict(free.tracker_mm < 1.15 * free.bound_mm),
        )
        yield (
            f"{what}: relative to known associations",
            f"{free.tracker_mm / free.known_mm:.3f} times",
            "1.15 times",
            _verdict(free.tracker_mm < 1.15 * free.known_mm),
        )
        # Free-running cameras see positions that an uncertain velocity has displaced, so their bound is higher. Only
        # the excess over the ratio of the bounds is a loss of the tracker.
        yield (
            f"{what}: by synchronised cameras; and the bounds' ratio",
            f"{free.tracker_mm / together.tracker_mm:.2f}, {free.bound_mm / together.bound_mm:.2f} times",
            "1.10 times",
            _verdict(free.tracker_mm < 1.1 * together.tracker_mm),
        )
        yield (
            f"{what}: squared error by covariance",
            f"{free.honesty:.2f}",
            "1",
            _verdict(free.honesty < 1.25),
        )
        yield (
            f"{what}: velocity, RMS, and squared error by covariance",
            f"{free.velocity_mm_s:.1f} mm/s, {free.velocity_honesty:.2f}",
            "1",
            _verdict(free.velocity_honesty < 1.5),
        )


def _capacities(thorough: bool) -> Iterator[Row]:
    for load in (FULL, *(replace(FULL, robots=robots) for robots in ((60, 70, 80) if thorough else ()))):
        got = capacity(load, 10.0 if thorough else 2.0)
        name = f"{load.robots} robots x {load.markers} x {load.cameras} cameras at {load.hz:g} Hz"
        goal = "5, 15 ms" if load is FULL else ""
        yield (
            f"{name}: from the last detection to the poses, p50 and p99",
            f"{got.p50_ms:.1f}, {got.p99_ms:.1f} ms",
            goal,
            _verdict(got.p50_ms < 5 and got.p99_ms < 15) if goal else "",
        )
        yield (
            f"{name}: core (quiet), robots tracked",
            f"{got.cpu:.0%} ({got.quiet_ms * load.hz / 1e3:.0%}), {got.tracked:.1%}",
            "100%, 99%",
            _verdict(got.cpu < 1 and got.tracked > 0.99),
        )


def _groupings(thorough: bool) -> Iterator[Row]:
    for sized in (True, False):
        runs = np.array([cold_grouping(seed, sized=sized) for seed in range(50 if thorough else 6)])
        (precision, recall), cost = runs[:, :2].mean(0), runs[:, 2].min() * 1e3
        what = "130 points in 10 views, 0.3 px, cold" + ("" if sized else ", sizes unknown")
        good = precision >= 0.999 and recall >= 0.99
        goal = "99.9%, 99%" + (", 20 ms" if sized else "")
        yield (
            what,
            f"{precision:.2%}, {recall:.2%}, {cost:.0f} ms",
            goal,
            _verdict(good and (cost < 20 or not sized)),
        )


def _identities(thorough: bool) -> Iterator[Row]:
    load = Load(20, 3, 8, 30.0, crossing=True)
    seconds = 600.0 if thorough else 10.0
    got = identity(load, seconds)
    what = f"20 robots x 3 markers crossing for {seconds:g} s: swaps, wrong poses, tracked"
    yield what, f"{got.swaps}, {got.wrong}, {got.tracked:.1%}", "0, 0", _verdict(got.wrong == 0)


def _growth(seconds: float) -> Table:
    """The cost of a frame set with one factor changed at a time; all loads alternate within one run.

    A share of tracked robots beside a cost marks loads in which the others are searched for in every frame set.
    """
    table = Table(
        "factor",
        *("",) * 3,
        title="5th percentile of the processor time of a frame set, and its growth from column to column"
        f"\n{MIDDLE.robots} robots x {MIDDLE.markers} markers x {MIDDLE.cameras} cameras at {MIDDLE.hz:g} Hz, "
        "except for the factor",
    )
    rows = {name: [replace(MIDDLE, **{name: value}) for value in values] for name, values in FACTORS.items()}
    loads = list({load: None for row in rows.values() for load in row})
    got = dict(zip(loads, compare(loads, seconds), strict=True))
    for name, row in rows.items():
        before = (row[0], *row[:-1])
        cells = (_cost(name, load, got[load], got[last]) for load, last in zip(row, before, strict=True))
        table.add_row(name, *cells)
    return table


def _cost(factor: str, load: Load, got: Capacity, before: Capacity) -> str:
    tracked = f", {got.tracked:.0%} tracked" if got.tracked < 0.99 else ""
    times = got.quiet_ms / before.quiet_ms
    return f"{getattr(load, factor):g}: {got.quiet_ms:.1f} ms, {times:.2f} times{tracked}"


def _verdict(good: bool) -> str:
    return "[green]met[/]" if good else "[red]missed[/]"


if __name__ == "__main__":
    tyro.cli(main)
