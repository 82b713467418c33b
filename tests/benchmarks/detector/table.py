# SPDX-License-Identifier: BSD-3-Clause
"""Tables of figures, verdicts on goals, and time measurements for benchmarks."""

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
    """The verdict on one goal; `met` is None if nothing was measured, `before` what it was when the goal was set."""

    what: str
    measured: str
    goal: str
    met: bool | None
    before: str = ""


@dataclass(frozen=True)
class Run:
    """The options of a run: the detector's name and constructor, how much to measure, and a seed for other pictures."""

    name: str
    make: MakeDetector
    thorough: bool
    seed: int = 0
    quick: bool = False


def table(title: str, headings: Iterable[str], rows: Iterable[Iterable[object]]) -> Table:
    """A table of figures with the first column left-aligned."""
    made = Table(title=title, title_justify="left")
    for k, heading in enumerate(headings):
        made.add_column(heading, justify="right" if k else "left")
    for row in rows:
        made.add_row(*map(str, row))
    return made


def print_verdicts(console: Console, name: str, verdicts: Iterable[Verdict]) -> None:
    """Print the verdicts on the goals of one detector."""
    marks = {True: "[green]met[/]", False: "[red]missed[/]", None: "-"}
    rows = [(v.what, v.before, v.measured, v.goal, marks[v.met]) for v in verdicts]
    console.print(table(f"{name}: goals", ("what", "before", "measured", "goal", ""), rows))


def milliseconds(work: Callable[[], object], seconds: float) -> float:
    """The processor time of one call: the first decile of many.

    The minimum is unsuitable because the thread clock of a virtual machine stops at times.
    """
    return milliseconds_prepared(lambda: work, seconds)


def milliseconds_prepared(prepare: Callable[[], Callable[[], object]], seconds: float) -> float:
    """The same for work that can be done only once after a preparation, which is not timed."""
    times, end = [], time.perf_counter() + seconds
    while time.perf_counter() < end or len(times) < 2:
        work = prepare()
        start = time.thread_time_ns()
        work()
        times.append(time.thread_time_ns() - start)
    return float(np.quantile(times, 0.1)) / 1e6
