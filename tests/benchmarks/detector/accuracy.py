# SPDX-License-Identifier: BSD-3-Clause
"""Errors over the Cramer-Rao bound: centre, distance, and whether the reported covariance says so."""

from dataclasses import dataclass

import numpy as np
from rich.console import Console

from camera_node.disc import locate
from tests.benchmarks.detector.bound import Bound, bound
from tests.benchmarks.detector.cells import Cell, cells, views
from tests.benchmarks.detector.pictures import expose
from tests.benchmarks.detector.table import Run, Verdict, table
from tests.camera_node.tracing import Array, Sight, ellipse_of, trace

CENTRE, CENTRE_WORST, DISTANCE, BIAS = 1.15, 1.3, 1.5, 5e-4


@dataclass(frozen=True)
class Errors:
    """What happened in a cell: means over all views found; the ratios are over the bound."""

    found: float
    centre: float
    chi2: float  # of the centre by its reported covariance, over its two degrees
    distance: float
    bias: float  # of the distance, over itself
    bias_sigma: float  # of that mean

    @property
    def biased(self) -> bool:
        """Beyond the goal by more than chance explains."""
        return abs(self.bias) > BIAS + 3 * self.bias_sigma


def measure_cell(run: Run, cell: Cell, count: int, draws: int) -> Errors:
    """`draws` exposures of each of `count` views."""
    rng = np.random.default_rng(round(1e3 * (cell.diameter + cell.tilt + cell.noise + cell.blur)))
    pieces = 6 if cell.diameter < 40 else 4
    rows: list[Array] = []
    for sight in views(cell, count, rng):
        limit, clean = bound(sight, pieces), trace(sight, pieces)
        frames = (expose(clean, cell.noise, rng) for _ in range(draws))
        rows += [
            row for image in frames if (row := _errors(run, image, sight, limit, cell.noise)) is not None
        ]
    if len(rows) < draws:
        return Errors(len(rows) / count / draws, *[np.nan] * 5)
    squared, variance, chi2, distance, distance_variance = np.array(rows).T
    spread = np.sqrt(((distance - distance.mean()) ** 2).mean() / distance_variance.mean())
    sigma = distance.std() / np.sqrt(len(rows))
    return Errors(
        len(rows) / count / draws,
        np.sqrt(squared.mean() / variance.mean()),
        chi2.mean() / 2,
        spread,
        distance.mean(),
        sigma,
    )


def _errors(run: Run, image: np.ndarray, sight: Sight, limit: Bound, noise: float) -> Array | None:
    """Of a centre's coordinate the squared error, its bound and chi-square; of the distance the error and its bound.

    None where the roundel was not found.
    """
    detector = run.make()
    found = detector.detect(image)
    if len(found) != 1:
        return None
    error = found[0].uv - ellipse_of(sight)[0]
    chi2 = error @ np.linalg.solve(found[0].cov, error)
    offsets, covs = detector.disc_offsets()
    poses = locate(found[0], sight.lens, sight.diameter_m, (offsets[0], covs[0]))
    if poses is None:
        return None
    distance = poses[0].position_m[2] / sight.distance_m - 1
    variances = limit.centre_variance(noise), limit.distance_variance(noise)
    return np.array([error @ error / 2, variances[0], chi2, distance, variances[1]])


def measure(run: Run, console: Console) -> list[Verdict]:
    """Print all cells; the verdicts on the goals of the issue."""
    count, draws = (12, 100) if run.thorough else (6, 50)
    done = {cell: measure_cell(run, cell, count, draws) for cell in cells(run.thorough)}
    headings = (
        "diameter",
        "tilt",
        "noise",
        "blur",
        "ground",
        "found",
        "centre/bound",
        "chi2/2",
        "distance/bound",
        "bias %",
    )
    rows = [
        (
            f"{c.diameter:g}",
            f"{c.tilt:g}",
            f"{c.noise:g}",
            f"{c.blur:g}",
            f"{c.ground:g}",
            f"{e.found:.2f}",
            f"{e.centre:.2f}",
            f"{e.chi2:.2f}",
            f"{e.distance:.2f}",
            f"{100 * e.bias:+.3f} ± {100 * e.bias_sigma:.3f}",
        )
        for c, e in done.items()
    ]
    console.print(table(f"{run.name}: errors over the Cramer-Rao bound", headings, rows))
    return _judge({c: e for c, e in done.items() if np.isfinite(e.centre)})


def _judge(done: dict[Cell, Errors]) -> list[Verdict]:
    centre = np.array([e.centre for e in done.values()])
    chi2 = np.array([e.chi2 for e in done.values()])
    slanted = [e for c, e in done.items() if 15 <= c.tilt <= 60]
    distance = np.array([e.distance for e in slanted])
    biased, bias = sum(e.biased for e in slanted), max((abs(e.bias) for e in slanted), default=np.nan)
    pooled = float(np.sqrt((centre**2).mean()))
    return [
        Verdict("centre over the bound, RMS of all cells", f"{pooled:.2f}", f"<= {CENTRE}", pooled <= CENTRE),
        Verdict(
            "centre over the bound, worst cell",
            f"{centre.max():.2f}",
            f"<= {CENTRE_WORST}",
            centre.max() <= CENTRE_WORST,
        ),
        Verdict(
            "chi-square of the covariance over 2",
            f"{chi2.min():.2f} to {chi2.max():.2f}",
            "0.8 to 1.25",
            bool(chi2.min() >= 0.8 and chi2.max() <= 1.25),
        ),
        Verdict(
            "distance over the bound, tilt 15 to 60, worst",
            f"{distance.max():.2f}",
            f"<= {DISTANCE}",
            bool(distance.max() <= DISTANCE),
        ),
        Verdict(
            "bias of the distance, worst cell",
            f"{100 * bias:.3f} %, {biased} of {len(slanted)} cells beyond",
            f"<= {100 * BIAS:g} %",
            biased == 0,
        ),
    ]
