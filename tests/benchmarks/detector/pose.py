# SPDX-License-Identifier: BSD-3-Clause
"""The normal from one view: how often the likelier one is wrong, overall and among those with high probability."""

import numpy as np
from rich.console import Console

from camera_node.detection.disc_pose import locate
from tests.benchmarks.detector.cells import Cell, views
from tests.benchmarks.detector.pictures import expose
from tests.benchmarks.detector.table import Run, Verdict, table
from tests.camera_node.tracing import trace

DIAMETERS, TILTS = (11, 15, 20, 30, 50), (15, 30, 45, 60)
SURE, WRONG = 0.99, 0.01


def judge_views(run: Run, cell: Cell, count: int, draws: int) -> np.ndarray:
    """(N, 2) for each detection: the probability of the likelier pose, and whether it is wrong."""
    rng = np.random.default_rng(int(100 * cell.diameter + cell.tilt))
    rows = []
    for sight in views(cell, count, rng):
        clean = trace(sight, 6 if cell.diameter < 40 else 4)
        for _ in range(draws):
            found = run.make().detect(expose(clean, cell.noise, rng))
            poses = locate(found[0], sight.lens, sight.diameter_m) if len(found) == 1 else None
            if poses:
                right, wrong = (pose.normal @ sight.normal for pose in poses)
                rows.append((poses[0].probability, float(right < wrong)))
    return np.array(rows).reshape(-1, 2)


def measure(run: Run, console: Console) -> list[Verdict]:
    """Print all cells and return the verdict on the goal."""
    count, draws = (60, 20) if run.thorough else (20, 10)
    done = {(d, t): judge_views(run, Cell(d, t), count, draws) for d in DIAMETERS for t in TILTS}
    rows = []
    for (d, t), judged in done.items():
        p, wrong = judged.T
        sure = p > SURE
        expected = (1 - p).mean() if len(p) else np.nan
        rows.append(
            (
                f"{d} px, {t} degrees",
                len(p),
                f"{100 * wrong.mean():.1f}" if len(p) else "-",
                f"{100 * expected:.1f}",
                int(sure.sum()),
                int(wrong[sure].sum()),
            )
        )
    headings = ("view", "found", "wrong %", "expected wrong %", "sure", "sure but wrong")
    console.print(table(f"{run.name}: the likelier normal", headings, rows))
    p, wrong = np.concatenate(list(done.values())).T
    sure = p > SURE
    share = wrong[sure].mean() if sure.any() else np.nan
    return [
        Verdict(
            f"normals with a probability > 99 % that are wrong ({sure.sum()} views)",
            f"{100 * share:.2f} %",
            "<= 1 %",
            bool(share <= WRONG),
        )
    ]
