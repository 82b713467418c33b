# SPDX-License-Identifier: BSD-3-Clause
"""Rolling shutters: `python -m tests.benchmarks.rolling_shutter`.

Four free-running cameras with a readout of 30 ms see three robots that drive at 2 m/s: tracking with a global shutter,
with row times ignored, and with row times used. Then wands before four such cameras: the readout times, clock offsets
and poses that the calibration finds, from recordings with and without a rolling shutter. Options: `--seeds N` (3),
`--readout-ms` (30), `--speed` (2 m/s). The simulation makes detections; each marker is seen when its row is read. With
`--images` it renders images with each row at its own time, detects the roundels in them and tracks the robots; the
calibration is left out. That takes 20 s a seed on a free core.
"""

import argparse
from collections.abc import Iterator, Sequence
from dataclasses import astuple, dataclass, replace

import numpy as np
from rich.console import Console
from rich.table import Table

from calib.rig.estimation import rms
from calib.wand.calibrate import calibrate
from calib.wand.wand_report import WandCalibration
from camera_node.foundation.arrays import Array
from camera_node.foundation.terminal import track
from camera_node.geometry.body import Body
from fusion.model.frames import CalibratedFrame, FrameSet
from fusion.model.states import States
from fusion.server.frame_synchronizer import FrameSynchronizer
from fusion.tracking.tracker import Tracker
from tests.benchmarks.calibration_honesty import clock_error
from tests.calib.recordings import SimulatedRecording, WandScenario, record
from tests.calib.synthetic import clock_errors_ms, joint_error
from tests.fusion.rendered_arena import RenderedArena
from tests.fusion.synthetic import PERIOD_NS, SINGLE, TRIANGLE, WIDE, Arena, drive

FRAMES, IMAGES, START_S = 120, 90, 1.5  # of each camera; robots accelerate during the first second
RADII_M = {"triangle": 0.5, "wide": 0.8, "single": 1.0}
ROBOTS = {"triangle": TRIANGLE, "wide": WIDE, "single": SINGLE}
STICK = Body(diameter_m=0.05, markers=((0.0, 0.0, 0.0), (0.5, 0.0, 0.0)))


@dataclass(frozen=True, slots=True)
class TrackingErrors:
    """RMS errors of position and of rotation, mean squared normalized errors of both, and the tracked share.

    Robots with one marker are apart; their rotation is that of the normal.
    """

    position_mm: float
    rotation_mrad: float
    nees: float
    single_mm: float
    normal_mrad: float
    single_nees: float
    tracked: float


def frame_sets(frames: Sequence[CalibratedFrame], uses_rows: bool) -> Iterator[FrameSet]:
    """All frame sets; without `uses_rows` as if all rows were captured at the time of the middle one."""
    synchronizer = FrameSynchronizer(PERIOD_NS)
    for frame in frames:
        synchronizer.add(frame if uses_rows else replace(frame, readout_s=0.0))
        yield from synchronizer.take(frame.t_ns)


def track_robots(arena: Arena, frames: Sequence[CalibratedFrame], uses_rows: bool) -> TrackingErrors:
    """Track the robots of an arena in its frames, and compare with the truth."""
    tracker = Tracker(arena.cameras, arena.robots)
    errors, tracked = {True: [], False: []}, []  # by whether the robot has one marker
    for frame_set in frame_sets(frames, uses_rows):
        tracker.track(frame_set)
        if Arena.seconds(frame_set.t_ns) < START_S:
            continue
        tracked += tracker.table.tracked.tolist()
        for k, (name, robot) in enumerate(arena.robots.items()):
            if tracker.table.tracked[k]:
                found = pose_error(tracker.table.states, k, *arena.truth(name, frame_set.t_ns))
                errors[len(robot.markers) == 1].append(found)
    robots, singles = (summarize(errors[single], free) for single, free in ((False, ()), (True, (2,))))
    return TrackingErrors(*robots, *singles, float(np.mean(tracked)))


def pose_error(states: States, k: int, R: Array, p: Array) -> tuple[Array, Array]:
    """(6,) error of rotation (body) and position, and its (6, 6) covariance."""
    E = R.T @ states.R[k]
    turn = np.array([E[2, 1] - E[1, 2], E[0, 2] - E[2, 0], E[1, 0] - E[0, 1]]) / 2
    return np.concatenate([turn, states.p[k] - p]), states.P[k][:6, :6]


def summarize(errors: Sequence[tuple[Array, Array]], free: Sequence[int]) -> tuple[float, float, float]:
    """RMS position (mm) and rotation (mrad), and mean squared normalized error, without the `free` components."""
    known = np.setdiff1d(np.arange(6), free)
    error = np.array([error for error, _ in errors])[:, known]
    cov = np.array([cov for _, cov in errors])[:, known[:, None], known]
    nees = np.einsum("ni,ni->n", error, np.linalg.solve(cov, error[:, :, None])[:, :, 0]) / len(known)
    position, rotation = (1e3 * np.sqrt((part**2).sum(1).mean()) for part in (error[:, -3:], error[:, :-3]))
    return float(position), float(rotation), float(nees.mean())


def calibrate_wand(readout_ms: float, seed: int) -> tuple[WandCalibration, SimulatedRecording]:
    """Record 20 s of a waved wand with cameras whose clocks differ, and calibrate."""
    scenario = WandScenario(
        cameras=4,
        seconds=20,
        rate_hz=30,
        sigma_px=0.2,
        outliers=0.02,
        both_sides=True,
        offset_ms=50,
        rolling_ms=readout_ms,
        wand=STICK,
        seed=seed,
    )
    recorded = record(scenario)
    return calibrate(recorded.intrinsics, STICK, recorded.messages), recorded


def track_in_shutters(
    kind: type[Arena], readout_s: float, speed_m_s: float, n_frames: int, seed: int
) -> list[TrackingErrors]:
    """The errors with a global shutter, with row times ignored, and with row times used."""
    motions = {name: drive(radius, speed_m_s) for name, radius in RADII_M.items()}
    exact, rolling = (kind(ROBOTS, motions, sigma_px=0.1, readout_s=s, seed=seed) for s in (0.0, readout_s))
    at_once, by_row = exact.frames(n_frames), rolling.frames(n_frames)
    cases = (exact, at_once, True), (rolling, by_row, False), (rolling, by_row, True)
    return [track_robots(*case) for case in cases]


def tracking_table(kind: type[Arena], readout_s: float, speed_m_s: float, n_frames: int, seeds: int) -> Table:
    """One row a kind of shutter and model, means over the seeds."""
    columns = (
        "position mm",
        "rotation mrad",
        "normalized",
        "single mm",
        "normal mrad",
        "normalized",
        "tracked",
    )
    table = Table("shutter", *columns)
    cases = [
        track_in_shutters(kind, readout_s, speed_m_s, n_frames, seed)
        for seed in track(range(1, seeds + 1), "tracking", seeds)
    ]
    readout = f"{1e3 * readout_s:g} ms, row times"
    for name, rows in zip(
        ("global", f"{readout} ignored", f"{readout} used"), zip(*cases, strict=True), strict=True
    ):
        means = np.mean([astuple(row) for row in rows], axis=0)
        table.add_row(name, *(f"{mean:.2f}" for mean in means[:-1]), f"{means[-1]:.1%}")
    return table


def calibration_table(readout_ms: float, seeds: int) -> Table:
    """One row a kind of shutter: RMS errors of the readout times and clock offsets, and normalized errors."""
    table = Table(
        "shutter", "readout error ms", "normalized", "offset error ms", "normalized", "poses normalized"
    )
    for name, readout in track({"global": 0.0, f"{readout_ms:g} ms": readout_ms}.items(), "calibrating", 2):
        readouts, offsets, normalized = [], [], []
        for seed in range(seeds):
            result, recorded = calibrate_wand(readout, seed)
            offsets.append(clock_errors_ms(result, recorded.truth))
            squared, degrees = joint_error(result, recorded.truth)
            normalized.append((clock_error(result, recorded.truth), squared / degrees))
            if result.readout_sigma_ms.any():
                readouts.append([result.readout_ms - readout, result.readout_sigma_ms])
        clocks, poses = np.mean(normalized, axis=0)
        table.add_row(
            name, *_readout_cells(np.array(readouts)), f"{rms(offsets):.3f}", f"{clocks:.2f}", f"{poses:.2f}"
        )
    return table


def _readout_cells(readouts: Array) -> tuple[str, str]:
    if not readouts.size:
        return "none found", "-"
    error, sigma = np.moveaxis(readouts, 1, 0)
    return f"{rms(error):.2f}", f"{np.mean((error / sigma) ** 2):.2f}"


def main() -> None:
    """Print both tables."""
    parser = argparse.ArgumentParser(prog="tests.benchmarks.rolling_shutter")
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--readout-ms", type=float, default=30.0)
    parser.add_argument("--speed", type=float, default=2.0)
    parser.add_argument("--images", action="store_true")
    options = parser.parse_args()
    console = Console(width=110)
    kind, n_frames = (RenderedArena, IMAGES) if options.images else (Arena, FRAMES)
    console.print(tracking_table(kind, 1e-3 * options.readout_ms, options.speed, n_frames, options.seeds))
    if not options.images:
        console.print(calibration_table(options.readout_ms, options.seeds))


if __name__ == "__main__":
    main()
