# SPDX-License-Identifier: BSD-3-Clause
"""Measures codes: `python -m tests.benchmarks.codes`.

Of coded and plain roundels in pictures of two generators: shares found and named, wrong names, headings (`--part
small` in small prints under several cameras, `--part sizes` by size and slant); names in pictures without codes
(`--part none`); square tags on the same scenes (`--part tags`). Of 60 identical robots that cross, are covered and
exchanged (`--part robots`): poses of another robot, and those that are missing. Of one roundel (`--part reading`):
microseconds of a read.
"""

import subprocess
import tempfile
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import tyro
from rich.console import Console

from tests.benchmarks.codes import comparison, pictures, robots
from tests.benchmarks.detector.table import table
from tests.conftest import ROOT
from tests.native import build

FAST = ("-O3", "-UROUNDEL_SCALAR")  # as the module is compiled
HEADING = ("heading, deg", "squared over claim")


def reading_times() -> list[tuple[str, ...]]:
    """Microseconds in which one code is read, by diameter and kind of roundel."""
    driver = Path(__file__).with_name("reading.cpp")
    with tempfile.TemporaryDirectory() as folder:
        native = ROOT / "camera_node" / "native"
        program = build(native, driver, Path(folder), ("code_book", "code_reader"), FAST)
        done = subprocess.run([program], capture_output=True, check=True, text=True, timeout=60)
    return [tuple(line.split()) for line in done.stdout.splitlines()]


@dataclass(frozen=True)
class Benchmark:
    """Measure codes by two generators of pictures, false names without codes, robots, and the time of a read."""

    count: int = 96
    """Roundels of a cell, at least."""
    pictures: int = 200
    """Pictures without codes of each kind."""
    part: Literal["small", "sizes", "none", "tags", "robots", "reading"] | None = None
    """Of the benchmark; all without it."""
    seconds: float = 8.0
    """Of the robots that cross."""

    def run(self) -> None:
        """Print the tables."""
        if self._measures("small"):
            headings = ("", "% plain found", "% coded found", "% named", "wrong", *HEADING)
            rows = (pictures.small_row(name, self.count) for name in pictures.SCENES)
            _print("11 to 14 px, up to 45 degrees, first picture", headings, rows)
        if self._measures("sizes"):
            headings = (
                "after 1 frame, after 10",
                "% plain found",
                "% coded found",
                "% named",
                "wrong",
                *HEADING,
            )
            cells = [(s, t, d) for s in pictures.SIZES for t, sizes in pictures.CELLS.items() for d in sizes]
            _print("by size and slant", headings, (pictures.size_row(*cell, self.count) for cell in cells))
        if self._measures("none"):
            headings = ("", "pictures", "roundels", "names")
            _print("without codes", headings, pictures.names_without_codes(self.pictures))
        if self._measures("tags"):
            headings = ("% read", *comparison.kinds())
            _print(
                "equal printed area, one picture of a mild camera",
                headings,
                comparison.rows(max(1, self.count // 48)),
            )
        if self._measures("reading"):
            headings = ("diameter, px", "coded", "coded, faint", "plain", "plain, on tiles")
            _print("microseconds of a read", headings, reading_times())
        if self._measures("robots"):
            headings = ("robots seen for 0.2 s", "% tracked", "poses of another", "missing")
            _print("60 identical robots", headings, [robots.crossing_robots(self.seconds)])

    def _measures(self, part: str) -> bool:
        return self.part in (None, part)


def _print(title: str, headings: Iterable[str], rows: Iterable[tuple[str, ...]]) -> None:
    """Each row as soon as it is measured, then the table."""
    console, measured = Console(width=140), []
    for row in rows:
        console.print(*row)
        measured.append(row)
    console.print(table(title, headings, measured))


if __name__ == "__main__":
    tyro.cli(Benchmark, prog="tests.benchmarks.codes").run()
