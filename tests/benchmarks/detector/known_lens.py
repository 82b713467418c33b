# SPDX-License-Identifier: BSD-3-Clause
"""Errors of detections that use the camera's intrinsics, over the Cramer-Rao bound that knows the lens and the print.

The normal is that of the likelier pose, in views in which it is the right one: which of the two poses is right is the
subject of `pose`.
"""

from dataclasses import dataclass

import numpy as np
from rich.console import Console

from camera_node.detection.disc_pose import locate
from camera_node.detection.known_lens import KnownLens
from camera_node.foundation.arrays import Array
from tests.benchmarks.detector.bound import PoseBound, pose_bound
from tests.benchmarks.detector.cells import Cell, views
from tests.benchmarks.detector.pictures import expose
from tests.benchmarks.detector.table import Run, Verdict, table
from tests.camera_node.tracing import Sight, ellipse_of, trace

DIAMETERS, TILTS = (12, 20, 30, 50, 70), (10, 30, 60)
GOAL = 1.15
CLAIM = (0.7, 1.4)  # mean squared error over the claimed variance, per coordinate


@dataclass(frozen=True)
class Errors:
    """RMS errors of a cell over the bound: of the centre without and with the lens, of size and normal with it.

    `chi2` is the squared error of the centre over its claimed covariance, per coordinate.
    """

    free: float
    centre: float
    size: float
    normal: float
    chi2: float


def measure_cell(run: Run, cell: Cell, count: int, draws: int) -> Errors:
    """Measure `draws` exposures of each of `count` views."""
    rng = np.random.default_rng(int(100 * cell.diameter + cell.tilt))
    pieces, rows = 6 if cell.diameter < 40 else 4, []
    for sight in views(cell, count, rng):
        limit, clean = pose_bound(sight, pieces, cell.noise), trace(sight, pieces)
        for _ in range(draws):
            rows.append(_errors(run, expose(clean, cell.noise, rng), sight, limit))
    squared = np.nanmean(np.array([row for row in rows if row is not None]), axis=0)
    free, centre, size, normal = np.sqrt(squared[:4])
    return Errors(free, centre, size, normal, squared[4])


def _errors(run: Run, image: np.ndarray, sight: Sight, limit: PoseBound) -> Array | None:
    """(5,) squared errors over the bound, and chi-square; NaN for the normal of the wrong pose."""
    found = run.make().detect(image)
    if len(found) != 1:
        return None
    refined = KnownLens(sight.lens).refine(found)
    poses = locate(found[0], sight.lens, sight.diameter_m)
    centre, axes = ellipse_of(sight)
    free, off = found.uv[0] - centre, refined.uv[0] - centre
    size = (refined.axes_px[0].sum() / axes.sum() - 1) / limit.size
    angle = np.nan
    if poses is not None:
        angles = [float(np.arccos(np.clip(pose.normal @ sight.normal, -1, 1))) for pose in poses]
        angle = angles[0] / limit.normal if angles[0] <= angles[1] else np.nan
    chi2 = off @ np.linalg.solve(refined.cov[0], off) / 2
    variance = 2 * limit.centre**2
    return np.array([free @ free / variance, off @ off / variance, size**2, angle**2 / 2, chi2])


def measure(run: Run, console: Console) -> list[Verdict]:
    """Print all cells and return the verdicts on the goals."""
    count, draws = (12, 100) if run.thorough else (6, 40)
    done = {(d, t): measure_cell(run, Cell(d, t), count, draws) for d in DIAMETERS for t in TILTS}
    rows = [
        (f"{d} px, {t} degrees", *(f"{x:.2f}" for x in (e.free, e.centre, e.size, e.normal, e.chi2)))
        for (d, t), e in done.items()
    ]
    headings = ("view", "centre, free", "centre", "size", "normal", "chi2/2")
    console.print(table(f"{run.name}: errors over the bound that knows lens and print", headings, rows))
    return [
        *(_judge(name, [getattr(e, name) for e in done.values()]) for name in ("centre", "size", "normal")),
        _judge_claim([e.chi2 for e in done.values()]),
    ]


def _judge(name: str, ratios: list[float]) -> Verdict:
    rms = float(np.sqrt(np.mean(np.square(ratios))))
    return Verdict(
        f"known lens: {name} over the bound, RMS of all cells (worst)",
        f"{rms:.2f} ({max(ratios):.2f})",
        f"<= {GOAL}",
        rms <= GOAL,
    )


def _judge_claim(chi2: list[float]) -> Verdict:
    low, high = min(chi2), max(chi2)
    return Verdict(
        "known lens: squared error of the centre over its claim, all cells",
        f"{low:.2f} to {high:.2f}",
        f"{CLAIM[0]} to {CLAIM[1]}",
        CLAIM[0] <= low and high <= CLAIM[1],
    )
