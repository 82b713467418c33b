# SPDX-License-Identifier: BSD-3-Clause
"""Sets our figures beside those of the paper: `python -m tests.benchmarks.paper [PART ...] [--write]`."""

import sys
from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, Literal

import cv2
import tyro

from tests.benchmarks.paper import comparison, distances, ranges, speed, threshold
from tests.benchmarks.paper.report import PAGE, Section, update_page

Part = Literal["speed", "distances", "ranges", "wall", "threshold", "markers", "all"]
PARTS: dict[str, Callable[[], Section]] = {
    "speed": speed.measure,
    "distances": distances.measure,
    "ranges": ranges.measure_range,
    "wall": ranges.measure_wall,
    "threshold": threshold.measure,
    "markers": comparison.measure,
}


@dataclass(frozen=True)
class PaperTables:
    """Measure Tables II to V and Section V-C of the paper, the threshold D, and markers of equal area.

    All random numbers are seeded. Times depend on the machine. All parts take about five minutes.
    """

    parts: Annotated[tuple[Part, ...], tyro.conf.Positional] = ("all",)
    """speed is Table II, distances III and IV, ranges V and L_max, wall Section V-C."""
    write: bool = False
    """Replace the parts in docs/paper_tables.md, and the plot."""

    def run(self) -> None:
        """Print each part when it is done."""
        cv2.setNumThreads(1)
        chosen = PARTS if "all" in self.parts else {name: PARTS[name] for name in dict.fromkeys(self.parts)}
        for name, measure in chosen.items():
            print(f"measuring {name}", file=sys.stderr, flush=True)
            section = measure()
            print(section.markdown(), flush=True)
            if self.write:
                update_page({name: section})
        if self.write:
            print(f"wrote {PAGE}", file=sys.stderr)


if __name__ == "__main__":
    tyro.cli(PaperTables, prog="tests.benchmarks.paper").run()
