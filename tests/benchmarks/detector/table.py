# SPDX-License-Identifier: BSD-3-Clause
"""What benchmarks print: tables of figures, then each goal with its verdict."""

import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np
from rich.console import Console
from rich.table import Table

from camera_node.detection.detector import Detector

MakeDetector = Callable[[], Detector]


@dataclass(frozen=True)
class Verdict:
    """One goal: what was measured, and whether it is met; None where there was nothing to measure."""

    what: str
    measured: str
    goal: str
    met: bool | None


@dataclass(frozen=True)
class Run:
    """How a benchmark runs: the detector under test by its name, and whether the whole grid is wanted."""

    name: str
    make: MakeDetector
    thorough: bool


def table(title: str, headings: Iterable[str], rows: Iterable[Iterable[object]]) -> Table:
    """A table of figures, the first column on the left."""
    made = Table(title=title, title_justify="left")
    for k, heading in enumerate(headings):
        made.add_column(heading, justify="right" if k else "left")
    for row in rows:
        made.add_row(*map(str, row))
    return made


def print_verdicts(console: Console, name: str, verdicts: Iterable[Verdict]) -> None:
    """The goals of one detector."""
    marks = {True: "[green]met[/]", False: "[red]missed[/]", None: "-"}
    rows = [(v.what, v.measured, v.goal, marks[v.met]) for v in verdicts]
    console.print(table(f"{name}: goals", ("what", "measured", "goal", ""), rows))


def milliseconds(work: Callable[[], object], seconds: float) -> float:
    """The processor time of one call when little else runs: of ten calls one takes less.

    Not the least of all, since a virtual machine's thread clock stands still now and then.
    """
    return milliseconds_anew(lambda: work, seconds)


def milliseconds_anew(prepare: Callable[[], Callable[[], object]], seconds: float) -> float:
    """The same of work that can be done once: what prepares it each time is not counted."""
    times, end = [], time.perf_counter() + seconds
    while time.perf_counter() < end or len(times) < 2:
        work = prepare()
        start = time.thread_time_ns()
        work()
        times.append(time.thread_time_ns() - start)
    return float(np.quantile(times, 0.1)) / 1e6
