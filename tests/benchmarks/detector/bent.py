# SPDX-License-Identifier: BSD-3-Clause
"""Roundels on paper that is bent to a part of a cylinder: shares found, and errors over claims, at 45 degrees."""

from dataclasses import dataclass

import numpy as np
from rich.console import Console

from camera_node.detection.roundels import Roundel
from camera_node.foundation.arrays import Array
from camera_node.geometry.lens import Lens
from tests.benchmarks.detector.pictures import NOISE, F, expose
from tests.benchmarks.detector.table import Run, Verdict, table
from tests.camera_node.tracing import Sight, ellipse_of, pixels_across, trace

BENDS = (0.0, 0.01, 0.02)  # height of the middle of the card over its diameter
DIAMETERS = (40, 80, 160)  # pixels
FOUND, BEND, CLAIM = 0.95, 0.02, 3.0


@dataclass(frozen=True)
class Errors:
    """Share found, and mean squared errors of the outline's centre and size over the claimed variances."""

    found: float
    centre: float
    size: float


def measure_bend(run: Run, bend: float, diameter: float, count: int) -> Errors:
    """Measure so many views; the true outline is that of a flat disc in the same place."""
    rng = np.random.default_rng((int(1000 * bend + diameter), run.seed))
    rows = []
    for _ in range(count):
        sight = _sight(bend, diameter, rng)
        found = run.make().detect(expose(trace(sight, 4), NOISE, rng))
        if len(found) == 1:
            rows.append(_errors(found[0], sight))
    centre, size = np.mean(rows, axis=0) if rows else (np.nan, np.nan)
    return Errors(len(rows) / count, float(centre), float(size))


def _sight(bend: float, diameter: float, rng: np.random.Generator) -> Sight:
    side = int(1.5 * diameter + 30)
    lens = Lens(width=side, height=side, fx=F, fy=F, cx=side / 2 + rng.uniform(-200, 200), cy=side / 2)
    uv = (side / 2 + rng.uniform(-0.5, 0.5), side / 2)
    turn = float(rng.uniform(0, 2 * np.pi))
    return Sight(lens, uv, pixels_across(lens, 0.1, diameter), tilt=np.pi / 4, turn=turn, bend=bend)


def _errors(found: Roundel, sight: Sight) -> Array:
    """(2,) squared errors of centre, per coordinate, and size over their variances."""
    assert found.pose_cov is not None
    centre, axes = ellipse_of(sight)
    off, trace_of = found.uv - centre, np.array([1.0, 0.0, 1.0])
    size = (found.axes_px.sum() - axes.sum()) / 2
    variance = trace_of @ found.pose_cov[2:5, 2:5] @ trace_of
    return np.array([off @ np.linalg.solve(found.cov, off) / 2, size**2 / variance])


def measure(run: Run, console: Console) -> list[Verdict]:
    """Print all sizes and return the verdicts on the goals for paper bent by 2 %."""
    count = 100 if run.thorough else 32
    done = {(b, d): measure_bend(run, b, d, count) for b in BENDS for d in DIAMETERS}
    rows = [
        (f"{100 * b:g} %, {d} px", f"{e.found:.2f}", f"{e.centre:.1f}", f"{e.size:.1f}")
        for (b, d), e in done.items()
    ]
    headings = ("bend, diameter", "found", "centre²/claim", "size²/claim")
    console.print(table(f"{run.name}: bent paper at 45 degrees", headings, rows))
    return [verdict for d in DIAMETERS for verdict in _judge(f"paper bent by 2 %, {d} px", done[BEND, d])]


def _judge(what: str, e: Errors) -> tuple[Verdict, Verdict]:
    claim = max(e.centre, e.size)
    return (
        Verdict(f"{what}, found", f"{100 * e.found:.0f} %", f">= {100 * FOUND:g} %", e.found >= FOUND),
        Verdict(f"{what}, squared error over claim", f"{claim:.1f}", f"<= {CLAIM:g}", bool(claim <= CLAIM)),
    )
