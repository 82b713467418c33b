# SPDX-License-Identifier: BSD-3-Clause
"""`python -m camera_node print`: draws a sheet of roundels as an SVG in millimetres, to be printed at 100 %."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from camera_node.config import write_atomically
from camera_node.errors import ConfigError
from camera_node.geometry.body import Body

PAPER_MM = {"a4": (210.0, 297.0), "a3": (297.0, 420.0), "letter": (215.9, 279.4)}
MARGIN_MM = 8.0  # unprintable margin of most printers; the scale is drawn in it


@dataclass(frozen=True)
class Sheet:
    """Write a sheet of roundels to print, with a scale to check the print."""

    out: Annotated[Path, tyro.conf.Positional]
    """The SVG file to write."""
    diameter: float = 0.12
    """Outer diameter d_o of the black disc, metres."""
    inner_ratio: float = 0.6
    """Inner over outer diameter, d_i / d_o."""
    surround_ratio: float = 9 / 7
    """White card over outer diameter, d / d_o; increase it for dark floors and distant cameras."""
    paper: str = "a4"
    """a4, a3 or letter."""

    def run(self) -> int:
        """Write the sheet and print the number of roundels on it."""
        svg, count = draw(self)
        write_atomically(self.out, svg)
        roundels = "1 roundel" if count == 1 else f"{count} roundels"
        size = f"d_o = {self.diameter * 1e3:g} mm"
        print(f"{self.out}: {roundels} of {size}; print at 100 %, then measure one of them")
        return 0


def draw(sheet: Sheet) -> tuple[str, int]:
    """Draw as many roundels as fit on the paper; return the SVG text and their number.

    Raises:
        ConfigError: a size is invalid, the paper is unknown, or a roundel is larger than the paper.
    """
    try:
        body = Body(
            diameter_m=sheet.diameter, inner_ratio=sheet.inner_ratio, surround_ratio=sheet.surround_ratio
        )
    except ValueError as error:
        raise ConfigError(f"invalid sheet: {error}") from None
    if sheet.paper not in PAPER_MM:
        raise ConfigError(f"--paper {sheet.paper} is not known; choose one of {', '.join(PAPER_MM)}")
    width, height = PAPER_MM[sheet.paper]
    d = 1e3 * body.diameter_m
    card = d * body.surround_ratio
    columns, rows = (int((size - 2 * MARGIN_MM) // card) for size in (width, height))
    if not columns or not rows:
        raise ConfigError(f"a card of {card:.0f} mm does not fit on {sheet.paper}; choose a larger --paper")
    centres = [
        ((c + 0.5) * width / columns, (r + 0.5) * height / rows) for r in range(rows) for c in range(columns)
    ]
    discs = "\n".join(_roundel(x, y, d, body.inner_ratio, card) for x, y in centres)
    return _page(width, height, discs, f"d_o = {d:g} mm"), len(centres)


def _roundel(x: float, y: float, d: float, inner_ratio: float, card: float) -> str:
    return (
        f'<circle cx="{x:.3f}" cy="{y:.3f}" r="{card / 2:.3f}" fill="none" stroke="#bbb" stroke-width="0.1"/>'
        f'<path fill="#000" fill-rule="evenodd" d="{_ring(x, y, d / 2)} {_ring(x, y, inner_ratio * d / 2)}"/>'
    )


def _ring(x: float, y: float, r: float) -> str:
    arc = f"A {r:.3f} {r:.3f} 0 1 0"
    return f"M {x - r:.3f} {y:.3f} {arc} {x + r:.3f} {y:.3f} {arc} {x - r:.3f} {y:.3f} Z"


def _page(width: float, height: float, discs: str, text: str) -> str:
    y = height - 2.5
    scale = f'<path d="M 10 {y:.1f} h 100 m 0 -1 v 2 m -100 -2 v 2" stroke="#000" stroke-width="0.2" fill="none"/>'
    label = f'<text x="112" y="{y + 1:.1f}" font-size="3.5" font-family="sans-serif">100 mm; {text}</text>'
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{width}mm" height="{height}mm" '
        f'viewBox="0 0 {width} {height}">\n{discs}\n{scale}\n{label}\n</svg>\n'
    )
