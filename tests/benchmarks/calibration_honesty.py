# SPDX-License-Identifier: BSD-3-Clause
"""Whether the wand calibration's covariances are true: `python -m tests.benchmarks.calibration honesty`.

One cell is a kind of clocks, wand and lenses and a duration. The figure of a cell is the mean squared error in
standard deviations over seeds, of poses, clocks and the scale: 1 for true covariances. "noise" is that of poses by the
noise of the image alone, without the part of the covariance for lens errors that the recording cannot show: of exact
lenses, that part claims errors that do not exist, so poses are below 1 and noise is not. Options: `--seeds N` (3),
`--cells TEXT ...` (only cells whose names contain all texts), such as `--cells sync 10s`.
"""

import argparse
import itertools
import time
from collections.abc import Callable
from dataclasses import astuple, dataclass, replace

import numpy as np
from rich.console import Console
from rich.table import Table

from calib.errors import CalibrationError
from calib.rig.camera import OFFSET, POSE
from calib.rig.rig import Rig
from calib.wand.bundle_adjustment.covariance import camera_covariance
from calib.wand.calibrate import calibrate
from calib.wand.result import WandCalibration
from camera_node.arrays import Array
from camera_node.geometry.body import Body
from camera_node.geometry.pose import rigid_motions
from camera_node.terminal import track
from tests.calib.recordings import SimulatedRecording, WandScenario, record
from tests.calib.synthetic import CAREFUL, OLD, WAND, joint_error, roughly

LIGHT = Body(diameter_m=0.05)
STICK = Body(diameter_m=0.05, markers=((0.0, 0.0, 0.0), (0.5, 0.0, 0.0)))
CLOCKS = {
    "sync": {"offset_ms": 0.0, "drift_ppm": 0.0, "free_running": False},
    "offset": {"offset_ms": 50.0, "drift_ppm": 0.0},
    "drift": {"offset_ms": 50.0, "drift_ppm": 100.0},
}
WANDS = {"light": LIGHT, "two": STICK, "three": WAND}
LENSES: dict[str, Callable[[Rig, int], Rig]] = {
    "exact": lambda rig, seed: rig,
    "calibrated": lambda rig, seed: roughly(rig, CAREFUL, with_sigma=True, seed=seed),
    "rough": lambda rig, seed: roughly(rig, OLD, seed=seed),
}
SECONDS = (10, 30, 60)
RATE_HZ, CAMERAS = 20.0, 4
LOW, HIGH = 0.6, 1.6


@dataclass(frozen=True, slots=True)
class CellErrors:
    """Mean squared normalized errors of one calibration; NaN where it does not estimate a quantity."""

    poses: float
    noise: float
    clocks: float
    scale: float


def cells() -> dict[str, tuple[str, str, str, int]]:
    """Clocks, wand, lenses and seconds, by name."""
    every = itertools.product(CLOCKS, WANDS, LENSES, SECONDS)
    return {
        f"{clock} {wand} {lens} {seconds}s": (clock, wand, lens, seconds)
        for clock, wand, lens, seconds in every
    }


def measure(clock: str, wand: str, lens: str, seconds: int, seed: int) -> CellErrors:
    """Simulate a recording with a seed, calibrate, and compare with the truth."""
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
    result = calibrate(LENSES[lens](recorded.intrinsics, seed), WANDS[wand], recorded.messages)
    squared, degrees = joint_error(result, recorded.truth)
    noise = joint_error(replace(result, covariance=noise_covariance(result)), recorded.truth)[0]
    return CellErrors(
        squared / degrees, noise / degrees, clock_error(result, recorded), scale_error(result, recorded.truth)
    )


def noise_covariance(result: WandCalibration) -> Array:
    """(6C, 6C) the part of the poses' covariance from the noise of the image."""
    covariance, size = camera_covariance(result.adjusted), 6 * len(result.names)
    at = [covariance.free.index(parameter) for parameter in POSE]
    return covariance.noise[:, at][:, :, :, at].reshape(size, size)


def clock_error(result: WandCalibration, recorded: SimulatedRecording) -> float:
    """Squared Mahalanobis error of the offsets, whose mean is unobservable, over its degrees of freedom."""
    if not result.time_sigma_ms.any():
        return float("nan")
    truth = np.array([recorded.truth.cameras[name].time_offset_ms for name in result.names])
    off = result.time_offset_ms - truth
    covariance = 1e6 * camera_covariance(result.adjusted).of(OFFSET)[:, 0, :, 0]
    complement = np.linalg.svd(np.ones((len(off), 1)))[0][:, 1:]
    rest = complement.T @ off
    return float(rest @ np.linalg.solve(complement.T @ covariance @ complement, rest)) / len(rest)


def scale_error(result: WandCalibration, truth: Rig) -> float:
    """Squared error of the scale of the cameras' centres, over its variance; NaN of a light, which has no scale."""
    if not result.report.metric:
        return float("nan")
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
    options = parser.parse_args(arguments)
    chosen = {name: cell for name, cell in cells().items() if set(options.cells) <= set(name.split())}
    table, start = Table("cell", "poses", "noise", "clocks", "scale", "seeds"), time.monotonic()
    outside = 0
    for name, cell in track(chosen.items(), "calibrating", len(chosen)):
        rows = []
        for seed in range(options.seeds):
            try:
                rows.append(astuple(measure(*cell, seed)))
            except CalibrationError as error:
                Console().print(f"{name}, seed {seed}: {error}")
        means = [_mean(column) for column in np.array(rows).reshape(-1, 4).T]
        poses, noise, *others = means
        outside += sum(not LOW <= mean <= HIGH for mean in (poses, *others) if np.isfinite(mean))
        table.add_row(name, _mark(poses), f"{noise:.2f}", *map(_mark, others), str(len(rows)))
    console = Console(width=100)
    console.print(table)
    console.print(f"{outside} figures outside of {LOW} to {HIGH}; {time.monotonic() - start:.0f} s")


def _mean(column: Array) -> float:
    known = column[np.isfinite(column)]
    return float(known.mean()) if len(known) else float("nan")


def _mark(mean: float) -> str:
    if not np.isfinite(mean):
        return "-"
    return f"{mean:.2f}" if LOW <= mean <= HIGH else f"{mean:.2f} !"
