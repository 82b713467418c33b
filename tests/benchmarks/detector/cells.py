# SPDX-License-Identifier: BSD-3-Clause
"""The combinations of size, tilt, noise, blur and ground at which accuracy is measured, and views of them."""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import product

import numpy as np

from camera_node.geometry.lens import Lens
from tests.benchmarks.detector.pictures import F
from tests.camera_node.tracing import Sight, pixels_across

DIAMETERS, TILTS = (11, 14, 20, 30, 50, 100), (0, 15, 30, 45, 60)
WHITE, GREY = 190.0, 90.0  # levels of the ground; on white the card's edge is invisible
NOISES, BLURS = (1.0, 3.0, 5.0), (0.5, 0.7, 1.0, 1.5)


@dataclass(frozen=True)
class Cell:
    """One combination: diameter in pixels, tilt in degrees, noise and ground in grey levels, blur in pixels."""

    diameter: float
    tilt: float
    noise: float = 3.0
    blur: float = 0.7
    ground: float = WHITE


def cells(thorough: bool) -> Iterator[Cell]:
    """The whole grid, or all tilts at every size and one tilt for the other parameters."""
    if thorough:
        yield from (Cell(*values) for values in product(DIAMETERS, TILTS, NOISES, BLURS, (WHITE, GREY)))
        return
    yield from (Cell(d, t) for d in DIAMETERS for t in (0, 30, 60))
    yield from (Cell(d, 30, n, b) for d, n, b in product((20, 50), (1.0, 5.0), (0.5, 1.5)))
    yield from (Cell(d, 30, ground=GREY) for d in DIAMETERS)


def views(cell: Cell, count: int, rng: np.random.Generator) -> Iterator[Sight]:
    """Roundels of a cell at random subpixel positions and directions of tilt, up to 200 px from the optical axis."""
    side = int(1.4 * cell.diameter + 8 * cell.blur + 10)
    for _ in range(count):
        cx, cy = rng.uniform(-200, 200, 2) + side / 2
        lens = Lens(width=side, height=side, fx=F, fy=F, cx=cx, cy=cy)
        uv = tuple(side / 2 + rng.uniform(-0.5, 0.5, 2))
        distance = pixels_across(lens, 0.1, cell.diameter)
        tilt, turn = float(np.radians(cell.tilt)), float(rng.uniform(0, 2 * np.pi))
        yield Sight(lens, uv, distance, tilt=tilt, turn=turn, blur=cell.blur, ground=cell.ground)
