# SPDX-License-Identifier: BSD-3-Clause
"""The planner compared with the simulated arena: `python -m tests.benchmarks.plan [PART]`; parts are named below.

`precision` renders roundels all over an arena, detects and tracks them, and compares their errors with the prediction.
`coverage` moves roundels through the predicted edges of what each camera sees, and finds where detection ends.
`cut` compares the precision that the detector reports of roundels which the border cuts with that of complete ones.
`placement` compares a suggested placement of eight cameras with a ring of eight, on one core.
"""

import time
from collections.abc import Sequence
from typing import Literal

import numpy as np
import tyro
from rich.console import Console
from rich.table import Table

from calib.plan.camera_kind import CameraKind
from calib.plan.description import Plan, PlannedRobots
from calib.plan.expected_error import CUT_EXPONENT
from calib.plan.placement import PlacementProblem, SuggestedPlaces, evaluate_placement, suggest_placement
from calib.plan.planner import PlannedArena, evaluate
from camera_node.foundation.arrays import Array
from camera_node.foundation.terminal import progress_bar
from tests.benchmarks.plan.arena import DIAMETER_M, HALF_M, HEIGHTS_M, SMALL_M
from tests.benchmarks.plan.coverage import CoverageResult, measure_coverage, measure_cut
from tests.benchmarks.plan.precision import PrecisionResult, measure_precision

EDGE_M = 0.05  # goal: distance of measured and predicted edges


def main(
    part: tyro.conf.Positional[Literal["precision", "coverage", "cut", "placement", "all"]] = "all",
    frames: int = 100,
    edges: int = 40,
) -> None:
    """Print the table.

    Args:
        part: what to measure.
        frames: frame sets for the precision.
        edges: paths for each camera for the coverage.
    """
    table = Table("what", "measured", "goal", title="roundel plan, compared with the simulated arena")
    if part in ("precision", "all"):
        _add_precision(table, measure_precision(frames))
    if part in ("coverage", "all"):
        for diameter_m in (DIAMETER_M, SMALL_M):
            table.add_row(f"roundels of {diameter_m:g} m", "", "")
            _add_coverage(table, measure_coverage(edges, diameter_m))
    if part in ("cut", "all"):
        _add_cut(table, measure_cut(edges))
    if part in ("placement", "all"):
        _add_placement(table)
    Console(width=150).print(table)


def _add_precision(table: Table, got: PrecisionResult) -> None:
    ratio = got.measured_mm / got.predicted_mm
    table.add_row(
        f"{got.robots} roundels in {2 * HALF_M:g} x {2 * HALF_M:g} m, z = {HEIGHTS_M[0]:g} to {HEIGHTS_M[1]:g} m: "
        "error within 20 % of the prediction",
        f"{got.within:.0%} ({len(ratio)} tracked)",
        "95%",
    )
    table.add_row(
        "measured by predicted error: median, 5 and 95 % quantile", _quantiles(ratio, "{:.2f}"), "1.00"
    )
    table.add_row("predicted error, mm", _quantiles(got.predicted_mm, "{:.3f}"), "")


def _add_coverage(table: Table, got: CoverageResult) -> None:
    image, size = got.distance_m[got.by_image], got.distance_m[~got.by_image]
    if len(image):
        table.add_row(
            f"{len(image)} edges by the image: within 5 cm; 95 % quantile of the distance, cm",
            f"{np.mean(np.abs(image) <= EDGE_M):.0%}; {100 * np.quantile(np.abs(image), 0.95):.1f}",
            "100%; 5",
        )
    if len(size):
        table.add_row(
            f"{len(size)} edges by size or slant: median distance and its standard error, cm; 10 and 90 % quantile",
            f"{100 * np.median(size):+.0f} +- {100 * _median_error(size):.0f}; "
            + _quantiles(100 * size, "{:+.0f}", (0.1, 0.9)),
            "within 5",
        )


def _median_error(values: Array, resamples: int = 500) -> float:
    """Standard error of the median of (N,) values, by the bootstrap."""
    drawn = np.random.default_rng(0).choice(values, (resamples, len(values)))
    return float(np.std(np.median(drawn, axis=1)))


def _add_cut(table: Table, rows: Sequence[tuple[float, float, int]]) -> None:
    for low, ratio, n in rows:
        goal = f"{min(low + 0.1, 1.0) ** -CUT_EXPONENT:.2f}"
        what = f"inset {low:.1f} to {low + 0.2:.1f}: sigma relative to a complete roundel ({n} detections)"
        table.add_row(what, f"{ratio:.2f}", goal)


def _add_placement(table: Table) -> None:
    """Eight cameras in 6 x 6 x 3 m, of the kind whose field of view suits the room."""
    kind = CameraKind(model="ov9281")
    robots = PlannedRobots(diameter_m=0.12, heights_m=(0.1, 1.5))
    plan = Plan(area_m=(-3.0, -3.0, 3.0, 3.0), ceiling_m=3.0, robots=robots)
    problem, aims = PlacementProblem(plan, kind), np.tile([0.0, 0.0, 0.8], (8, 1))
    corners = np.array([(x, y, 3.0) for x in (-3, 0, 3) for y in (-3, 0, 3) if (x, y) != (0, 0)], float)
    ring, start = evaluate_placement(problem, corners, aims), time.process_time()
    with progress_bar("placing") as progress:
        best = suggest_placement(problem, 8, progress)
    seconds = time.process_time() - start
    table.add_row("8 cameras in 6 x 6 x 3 m: processor time", f"{seconds:.0f} s", "60 s")
    for name, places in (("ring", ring), ("suggested", best)):
        table.add_row(f"8 cameras, {name}", _describe_places(plan, kind, places), "less than the ring")


def _describe_places(plan: Plan, kind: CameraKind, places: SuggestedPlaces) -> str:
    got = evaluate(PlannedArena.of_cameras(plan, places.cameras(kind), kind))
    return (
        f"expected error {1e3 * places.cost_m:.1f} mm with blind places as {1e3 * 0.05 * 3**0.5:.0f} mm; "
        f"{got.covered.mean():.0%} covered, median {got.median_mm:.2f} mm there"
    )


def _quantiles(values: Array, form: str, at: Sequence[float] = (0.5, 0.05, 0.95)) -> str:
    return ", ".join(form.format(x) for x in np.quantile(values, at, method="nearest"))


if __name__ == "__main__":
    tyro.cli(main)
