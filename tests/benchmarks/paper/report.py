# SPDX-License-Identifier: BSD-3-Clause
"""Tables of figures as Markdown, for the terminal and for the documentation."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from tests.conftest import ROOT

PAGE = ROOT / "docs" / "paper_tables.md"
PLOTS = ROOT / "docs"


@dataclass(frozen=True)
class Section:
    """One part of the page: heading, text, tables, and rows in which ours is not better."""

    heading: str
    text: str
    tables: Sequence[str]
    worse: Sequence[str] = ()

    def markdown(self) -> str:
        """The section as Markdown."""
        lines = [f"## {self.heading}", "", self.text, ""]
        for table in self.tables:
            lines += [table, ""]
        if self.worse:
            lines += ["Not better than the paper: " + "; ".join(self.worse) + ".", ""]
        return "\n".join(lines)


def table(headings: Iterable[str], rows: Iterable[Iterable[object]]) -> str:
    """A Markdown table; columns after the first are right-aligned."""
    names = list(headings)
    lines = [_row(names), _row(["---", *["---:"] * (len(names) - 1)])]
    return "\n".join([*lines, *(_row(map(str, row)) for row in rows)])


def _row(cells: Iterable[str]) -> str:
    return f"| {' | '.join(cells)} |"


def name_of(resolution: tuple[int, int]) -> str:
    """Such as 640x480."""
    return f"{resolution[0]}x{resolution[1]}"


def update_page(parts: Mapping[str, Section], path: Path = PAGE) -> None:
    """Replace the text between the comments `<!-- begin PART -->` and `<!-- end PART -->` of each part in a page.

    Raises:
        ValueError: the page lacks the comments of a part.
    """
    text = path.read_text()
    for part, section in parts.items():
        begin, end = f"<!-- begin {part} -->\n", f"<!-- end {part} -->"
        if begin not in text or end not in text:
            raise ValueError(f"{path} has no {begin.strip()} or no {end}; add both")
        before, rest = text.split(begin)
        text = before + begin + section.markdown() + end + rest.split(end)[1]
    path.write_text(text)
