# SPDX-License-Identifier: BSD-3-Clause
"""Whether the wand calibration's covariances are true: `python -m tests.benchmarks.calibration honesty`.

One cell is a kind of clocks, wand and lenses and a duration. The figure of a cell is the mean squared error in
standard deviations over seeds, of poses, clocks, the scale and focal lengths: 1 for true covariances. "noise" is that
of poses by the noise of the image alone, without the part of the covariance for lens errors that the recording cannot
show.

Lenses: "exact" ones are declared so by their files (`lens_sigma` 0), "calibrated" ones are off by what their files
state, "rough" ones by 0.4 %, and of "unstated" ones, which are exact too, no file says so: there the covariance claims
errors that do not exist (DECISIONS 18), so poses are below 1 and noise is not. "unknown" ones start without distortion
from focal lengths that are wrong by factors between 1/2 and 2, each camera's by another, as of image sizes alone.

A figure outside of 0.6 to 1.6 is marked with "!", and with "?" if its standard error over seeds may explain it.
Options: `--seeds N` (3), `--jobs N` processes (all processors), `--save FILE`: results are added to the file, and
those that it has are not computed again. `--cells TEXT ...`: only cells whose names have a word for each of these
texts, such as `--cells sync 10s`; a text may name several words, `--cells exact,rough 10s`.
"""

import argparse
import itertools
import os
import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import replace
from multiprocessing import get_context
from pathlib import Path

import msgspec
import numpy as np
from rich.console import Console
from rich.table import Table

from calib.errors import CalibrationError
from calib.rig.camera import LENS, OFFSET, POSE, lens_parameters
from calib.rig.rig import Rig
from calib.wand.bundle_adjustment.covariance import camera_covariance
from calib.wand.calibrate import calibrate
from calib.wand.nominal_lens import nominal_lens
from calib.wand.wand_report import WandCalibration
from camera_node.foundation.arrays import Array
from camera_node.foundation.terminal import track
from camera_node.geometry.body import Body
from camera_node.geometry.pose import rigid_motions
from tests.calib.recordings import WandScenario, record
from tests.calib.synthetic import CAREFUL, EXACT, OLD, WAND, joint_error, roughly

LIGHT = Body(diameter_m=0.05)
STICK = Body(diameter_m=0.05, markers=((0.0, 0.0, 0.0), (0.5, 0.0, 0.0)))
CLOCKS = {
    "sync": {"offset_ms": 0.0, "drift_ppm": 0.0, "free_running": False},
    "offset": {"offset_ms": 50.0, "drift_ppm": 0.0},
    "drift": {"offset_ms": 50.0, "drift_ppm": 100.0},
}
WANDS = {"light": LIGHT, "two": STICK, "three": WAND}
LENSES: dict[str, Callable[[Rig, int], Rig]] = {
    "exact": lambda rig, seed: roughly(rig, EXACT, with_sigma=True),
    "unstated": lambda rig, seed: rig,
    "calibrated": lambda rig, seed: roughly(rig, CAREFUL, with_sigma=True, seed=seed),
    "rough": lambda rig, seed: roughly(rig, OLD, seed=seed),
    "unknown": lambda rig, seed: without_lenses(rig, seed),
}
SECONDS = (10, 30, 60)
RATE_HZ, CAMERAS = 20.0, 4
LOW, HIGH = 0.6, 1.6


class Outcome(msgspec.Struct, frozen=True):
    """One calibration: squared normalized errors, None where it does not estimate a quantity, or why it failed."""

    cell: str
    seed: int
    poses: float | None = None
    noise: float | None = None
    clocks: float | None = None
    scale: float | None = None
    focal: float | None = None
    fault: str = ""


FIGURES = ("poses", "noise", "clocks", "scale", "focal")


def cells() -> dict[str, tuple[str, str, str, int]]:
    """Clocks, wand, lenses and seconds, by name."""
    every = itertools.product(CLOCKS, WANDS, LENSES, SECONDS)
    return {
        f"{clock} {wand} {lens} {seconds}s": (clock, wand, lens, seconds)
        for clock, wand, lens, seconds in every
    }


def measure(name: str, seed: int) -> Outcome:
    """Simulate a recording of a cell with a seed, calibrate, and compare with the truth."""
    clock, wand, lens, seconds = cells()[name]
    scenario = WandScenario(
        cameras=CAMERAS,
        wand=WANDS[wand],
        seconds=seconds,
        rate_hz=RATE_HZ,
        sigma_px=0.2,
        outliers=0.02,
        numbered=True,
        sized=False,
        both_sides=True,
        seed=seed,
        **CLOCKS[clock],
    )
    recorded = record(scenario)
    try:
        result = calibrate(LENSES[lens](recorded.intrinsics, seed), WANDS[wand], recorded.messages)
    except CalibrationError as error:
        return Outcome(name, seed, fault=str(error))
    return judge(name, seed, result, recorded.truth)


def judge(cell: str, seed: int, result: WandCalibration, truth: Rig) -> Outcome:
    """Compare a calibration with the truth."""
    squared, degrees = joint_error(result, truth)
    noise = joint_error(replace(result, covariance=noise_covariance(result)), truth)[0]
    clocks, scale, focal = clock_error(result, truth), scale_error(result, truth), focal_error(result, truth)
    return Outcome(cell, seed, squared / degrees, noise / degrees, clocks, scale, focal)


def without_lenses(rig: Rig, seed: int) -> Rig:
    """The rig with nominal lenses, with focal lengths between half and twice the true ones."""
    rng, cameras = np.random.default_rng([11, seed]), {}
    for name, camera in rig.cameras.items():
        focal = float(np.exp(np.log(camera.fx * camera.fy) / 2 + np.log(2) * rng.uniform(-1, 1)))
        cameras[name] = nominal_lens(camera.width, camera.height, field_of_view(camera.width, focal))
    return Rig(cameras=cameras)


def field_of_view(width: int, focal_px: float) -> float:
    """The horizontal field of view, degrees."""
    return float(np.degrees(2 * np.arctan(width / 2 / focal_px)))


def focal_error(result: WandCalibration, truth: Rig) -> float:
    """Squared Mahalanobis error of the logarithms of all focal lengths, over their number."""
    off = [
        lens_parameters(result.rig.cameras[n])[0] - lens_parameters(truth.cameras[n])[0] for n in result.names
    ]
    covariance = camera_covariance(result.adjusted).of(LENS[:1])[:, 0, :, 0]
    return float(np.array(off) @ np.linalg.solve(covariance, off)) / len(off)


def noise_covariance(result: WandCalibration) -> Array:
    """(6C, 6C) the part of the poses' covariance from the noise of the image."""
    covariance, size = camera_covariance(result.adjusted), 6 * len(result.names)
    at = [covariance.free.index(parameter) for parameter in POSE]
    return covariance.noise[:, at][:, :, :, at].reshape(size, size)


def clock_error(result: WandCalibration, truth: Rig) -> float | None:
    """Squared Mahalanobis error of the offsets, whose mean is unobservable, over its degrees of freedom; None where
    these are not estimated."""
    if not result.time_sigma_ms.any():
        return None
    off = result.time_offset_ms - [truth.cameras[name].time_offset_ms for name in result.names]
    covariance = 1e6 * camera_covariance(result.adjusted).of(OFFSET)[:, 0, :, 0]
    return error_of_differences(off, covariance, np.ones((len(off), 1)))


def error_of_differences(off: Array, covariance: Array, common: Array) -> float:
    """Squared Mahalanobis error over its degrees of freedom, without what nothing shows.

    Args:
        off: (N,) errors.
        covariance: (N, N) their covariance.
        common: (N, K) what may be added to all errors.
    """
    complement = np.linalg.svd(common)[0][:, common.shape[1] :]
    rest = complement.T @ off
    return float(rest @ np.linalg.solve(complement.T @ covariance @ complement, rest)) / len(rest)


def scale_error(result: WandCalibration, truth: Rig) -> float | None:
    """Squared error of the scale of the cameras' centres, over its variance; None of a light, which has no scale."""
    if not result.report.metric:
        return None
    found, there = (np.array([rig.cameras[n].matrix() for n in result.names]) for rig in (result.rig, truth))
    align = rigid_motions(found[:, :3, 3], there[:, :3, 3])
    moved = found[:, :3, 3] @ align[:3, :3].T + align[:3, 3]
    arms = there[:, :3, 3] - there[:, :3, 3].mean(axis=0)
    by_position = arms / (arms**2).sum()
    scale = float((by_position * (moved - there[:, :3, 3])).sum())
    J = np.zeros((len(arms), 6))
    J[:, 3:] = np.einsum("cij,ci->cj", there[:, :3, :3], by_position)
    variance = float(J.ravel() @ result.covariance @ J.ravel())
    return scale**2 / variance


def run(arguments: list[str]) -> None:
    """Print a row for each cell; figures outside of 0.6 to 1.6 are marked."""
    parser = argparse.ArgumentParser(prog="tests.benchmarks.calibration honesty")
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--cells", nargs="*", default=[])
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--save", type=Path)
    options = parser.parse_args(arguments)
    start, chosen = time.monotonic(), choose_cells(options.cells)
    # Seeds in the outer loop: a run that is ended early has all cells.
    wanted = [(name, seed) for seed in range(options.seeds) for name in chosen]
    known = {(o.cell, o.seed): o for o in load(options.save)}
    missing = [task for task in wanted if task not in known]
    for outcome in track(compute(measure, missing, options.jobs), "calibrating", len(missing)):
        known[outcome.cell, outcome.seed] = outcome
        if options.save is not None:
            with options.save.open("ab") as file:
                file.write(msgspec.json.encode(outcome) + b"\n")
    report([known[task] for task in wanted])
    Console().print(f"{len(missing)} calibrations in {time.monotonic() - start:.0f} s")


def choose_cells(texts: Sequence[str]) -> list[str]:
    """The names of the cells that have one of the words of each text."""
    words = [set(text.split(",")) for text in texts]
    return [name for name in cells() if all(group & set(name.split()) for group in words)]


def load(path: Path | None) -> list[Outcome]:
    """The outcomes that earlier runs saved."""
    if path is None or not path.exists():
        return []
    return [msgspec.json.decode(line, type=Outcome) for line in path.read_bytes().splitlines()]


def compute(
    measure: Callable[[str, int], Outcome], tasks: Sequence[tuple[str, int]], jobs: int
) -> Iterator[Outcome]:
    """Measure cells with seeds in several processes, each with one thread; yields outcomes as they come."""
    os.environ |= dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1")  # of the processes
    with ProcessPoolExecutor(jobs, get_context("spawn")) as pool:
        for future in as_completed([pool.submit(measure, *task) for task in tasks]):
            yield future.result()


def report(outcomes: Sequence[Outcome]) -> None:
    """Print the figures of each cell, and why calibrations failed."""
    console, table = Console(width=100), Table("cell", *FIGURES, "seeds")
    by_cell: dict[str, list[Outcome]] = defaultdict(list)
    for outcome in outcomes:
        by_cell[outcome.cell].append(outcome)
        if outcome.fault:
            console.print(f"{outcome.cell}, seed {outcome.seed}: {outcome.fault}")
    marks = ""
    for name, several in by_cell.items():
        figures = {f: [v for o in several if (v := getattr(o, f)) is not None] for f in FIGURES}
        marked = {figure: _mark(values) for figure, values in figures.items()}
        marks += "".join(marked[figure] for figure in FIGURES if figure != "noise")
        table.add_row(name, *marked.values(), str(len(several)))
    console.print(table)
    console.print(
        f"outside of {LOW} to {HIGH}: {marks.count('!')} figures, and {marks.count('?')} by at most two standard errors"
    )


def _mark(values: Sequence[float]) -> str:
    """The mean, and whether it is outside of the limits: surely or perhaps."""
    if not values:
        return "-"
    mean = float(np.mean(values))
    error = float(np.std(values, ddof=1)) / len(values) ** 0.5 if len(values) > 1 else np.inf
    outside = max(LOW - mean, mean - HIGH)
    return f"{mean:.2f}" + (" !" if outside > 2 * error else " ?" if outside > 0 else "")
