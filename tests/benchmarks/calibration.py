# SPDX-License-Identifier: BSD-3-Clause
"""Accuracy and speed of the wand calibration: `python -m tests.benchmarks.calibration [ROW ...]`.

Rows are simulated recordings (`tests.calib.recordings`), and the real recordings of ../shared/data if they are beside
the checkout. Times are processor seconds, and in brackets multiples of a Cholesky factorization of 1500 x 1500 in the
same run. `honesty` measures whether covariances are true (`calibration_honesty`), `acceptance` the same of hard
recordings (`calibration_acceptance`), and `data` compares with a plain bundle adjustment (`calibration_data`).
"""

import os
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from typing import TypeVar

from calib.rig.estimation import rms

# Before NumPy is loaded, as in the programs that calibrate.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
from rich.console import Console
from rich.table import Table

from calib.rig.rig import Rig
from calib.wand.calibrate import calibrate
from camera_node.geometry.body import Body
from tests.benchmarks.calibration_acceptance import run as run_acceptance
from tests.benchmarks.calibration_data import run as run_data
from tests.benchmarks.calibration_honesty import run as run_honesty
from tests.benchmarks.calibration_recordings import DATA, SQUARE_M, board_corners, corner_errors, recording
from tests.calib.recordings import SimulatedRecording, WandScenario, record
from tests.calib.synthetic import CAREFUL, OLD, SHEET, camera_errors, clock_errors_ms, joint_error, roughly

SEEDS = 3  # recordings of each simulated row
Row = tuple[str, str, str]
T = TypeVar("T")


def reference_s() -> float:
    """Processor seconds of the Cholesky factorization, the unit of relative times."""
    A = np.random.default_rng(0).standard_normal((1500, 1500))
    A = A @ A.T + 1500 * np.eye(1500)
    return min(timed(lambda: np.linalg.cholesky(A))[1] for _ in range(3))


def timed(work: Callable[[], T]) -> tuple[T, float]:
    """The result of `work`, and its processor seconds."""
    start = time.process_time()
    result = work()
    return result, time.process_time() - start


def simulated(
    scenario: WandScenario,
    goal_s: float,
    lenses: Callable[[SimulatedRecording], Rig] = lambda recorded: recorded.intrinsics,
) -> tuple[list[Row], float]:
    """Errors against the truth over `SEEDS` recordings, with true or other lenses; of offsets against their mean,
    because the offset that all clocks share is unobservable. One recording alone differs by 20 % by chance."""
    runs = [_run(replace(scenario, seed=scenario.seed + k), lenses) for k in range(SEEDS)]
    placed, shift, turn, offset, squared, degrees, cost = (
        np.array(column) for column in zip(*runs, strict=True)
    )
    cost_s = float(cost.mean())
    rows = [
        ("cameras placed", f"{placed.min()}", f"{scenario.cameras}"),
        ("centres, mm RMS", f"{1e3 * rms(shift):.3f}", "<= 1"),
        ("rotations, degrees RMS", f"{np.degrees(rms(turn)):.4f}", "<= 0.02"),
        ("time offsets, ms RMS", f"{rms(offset):.3f}", "<= 0.3"),
        ("squared Mahalanobis error", f"{squared.sum():.0f}", _chi_square(int(degrees.sum()))),
        ("seconds", f"{cost_s:.2f}", f"<= {goal_s:g}"),
    ]
    return rows, cost_s


def _run(
    scenario: WandScenario, lenses: Callable[[SimulatedRecording], Rig]
) -> tuple[int, float, float, float, float, int, float]:
    """Cameras placed, RMS errors of positions (m), rotations (rad) and offsets (ms), the squared Mahalanobis error and
    its degrees of freedom, and processor seconds, of one recording."""
    recorded = record(scenario)
    result, cost = timed(lambda: calibrate(lenses(recorded), scenario.wand, recorded.messages))
    shift, turn = camera_errors(result.rig, recorded.truth)
    squared, degrees = joint_error(result, recorded.truth)
    return (
        len(result.rig.placed()),
        rms(shift),
        rms(turn),
        rms(clock_errors_ms(result, recorded.truth)),
        squared,
        degrees,
        cost,
    )


def _chi_square(degrees: int) -> str:
    return f"{degrees} +- {np.sqrt(2 * degrees):.0f}"


def waved_led() -> tuple[list[Row], float]:
    """A real LED, one marker."""
    rig, messages = recording(DATA / "waved_led" / "observations.csv")
    result, cost = timed(lambda: calibrate(rig, Body(diameter_m=0.1), messages))
    adjusted = result.adjusted
    used = np.linalg.norm(adjusted.residuals[adjusted.used], axis=1)
    rows = [
        ("cameras placed", f"{len(result.rig.placed())}", "4"),
        ("mean residual, px", f"{used.mean():.3f}", "<= 0.30"),
        ("rejected", f"{(~adjusted.used).sum()} of {len(adjusted.used)}", ""),
        ("seconds", f"{cost:.2f}", "<= 1"),
    ]
    return rows, cost


def webcams_wand() -> tuple[list[Row], float]:
    """Two corners of a real board as a wand; then distances of all triangulated corners against the board."""
    rig, messages = recording(DATA / "webcams" / "wand_observations.csv")
    length = SQUARE_M * np.hypot(2, 3)
    wand = Body(diameter_m=0.05, markers=((0.0, 0.0, 0.0), (float(length), 0.0, 0.0)))
    result, cost = timed(lambda: calibrate(rig, wand, messages))
    errors = corner_errors(result.rig, recording(DATA / "webcams" / "corners_observations.csv")[1])
    rows = [
        ("cameras placed", f"{len(result.rig.placed())}", "4"),
        ("distances of held-out corners, mm RMS", f"{1e3 * rms(errors):.3f}", "<= 0.8"),
        ("distances", f"{len(errors)}", ""),
        ("seconds", f"{cost:.2f}", "<= 2"),
    ]
    return rows, cost


def webcams_board() -> tuple[list[Row], float]:
    """All corners of the same board as a wand of twelve markers."""
    rig, messages = recording(DATA / "webcams" / "corners_observations.csv")
    result, cost = timed(lambda: calibrate(rig, Body(diameter_m=0.05, markers=board_corners()), messages))
    adjusted = result.adjusted
    every, used = adjusted.residuals, adjusted.residuals[adjusted.used]
    rows = [
        ("cameras placed", f"{len(result.rig.placed())}", "4"),
        ("residual, px RMS", f"{np.sqrt((used**2).sum(axis=1).mean()):.3f}", "<= 0.585"),
        ("residual with rejected ones", f"{np.sqrt((every**2).sum(axis=1).mean()):.3f}", ""),
        ("rejected", f"{(~adjusted.used).sum()} of {len(adjusted.used)}", ""),
        ("seconds", f"{cost:.2f}", ""),
    ]
    return rows, cost


ROWS: dict[str, Callable[[], tuple[list[Row], float]]] = {
    "simulated-8": lambda: simulated(WandScenario(cameras=8), 5),
    "simulated-16": lambda: simulated(WandScenario(cameras=16), 10),
    "simulated-32": lambda: simulated(WandScenario(cameras=32), 10),
    "simulated-64": lambda: simulated(WandScenario(cameras=64), 30),
    "lenses-as-calibrated": lambda: simulated(
        WandScenario(cameras=8), 5, lambda recorded: roughly(recorded.intrinsics, CAREFUL, with_sigma=True)
    ),
    "lenses-0.4-%": lambda: simulated(
        WandScenario(cameras=8), 5, lambda recorded: roughly(recorded.intrinsics, OLD)
    ),
    "lenses-2-%": lambda: simulated(
        WandScenario(cameras=8), 5, lambda recorded: roughly(recorded.intrinsics, SHEET)
    ),
    "simulated-numbered": lambda: simulated(WandScenario(cameras=8, numbered=True, sized=False, seed=1), 3),
    "simulated-16-numbered": lambda: simulated(WandScenario(cameras=16, numbered=True, sized=False), 5),
    "waved-led": waved_led,
    "webcams-wand": webcams_wand,
    "webcams-board": webcams_board,
}


def main(names: list[str]) -> None:
    """Print the measured figures beside their goals."""
    if unknown := [name for name in names if name not in ROWS]:
        raise SystemExit(
            f"no rows {' '.join(unknown)}; the rows are {' '.join(ROWS)}; or give honesty, acceptance or data"
        )
    console, unit = Console(), reference_s()
    table = Table("row", "figure", "measured", "goal")
    for name in names or ROWS:
        try:
            rows, cost = ROWS[name]()
        except FileNotFoundError as missing:
            console.print(f"{name}: {missing} is absent")
            continue
        for figure, measured, goal in rows:
            value = f"{measured} ({cost / unit:.0f})" if figure == "seconds" else measured
            table.add_row(name, figure, value, goal)
        table.add_section()
    console.print(table)


if __name__ == "__main__":
    others = {"honesty": run_honesty, "acceptance": run_acceptance, "data": run_data}
    name, *arguments = sys.argv[1:] or [""]
    if name in others:
        others[name](arguments)
    else:
        main(sys.argv[1:])
