# SPDX-License-Identifier: BSD-3-Clause
"""Rolling shutters: `python -m tests.benchmarks.rolling_shutter`.

Four free-running cameras with a readout of 30 ms see three robots that drive at 2 m/s: tracking with a global shutter,
with row times ignored, and with row times used. Then wands before four such cameras: the readout times, clock offsets
and poses that the calibration finds, from recordings with and without a rolling shutter. Options: `--seeds N` (3),
`--readout-ms` (30), `--speed` (2 m/s). The simulation makes detections, not images; each marker is seen when its row is
read.
"""

import argparse
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from rich.console import Console
from rich.table import Table

from calib.wand.calibrate import calibrate
from calib.wand.result import WandCalibration
from camera_node.arrays import Array
from camera_node.geometry.body import Body
from camera_node.terminal import track
from fusion.model.frames import FrameSet
from fusion.server.frame_synchronizer import FrameSynchronizer
from fusion.tracking.tracker import Tracker
from tests.benchmarks.calibration_honesty import clock_error
from tests.calib.recordings import SimulatedRecording, WandScenario, record
from tests.calib.synthetic import joint_error
from tests.fusion.synthetic import PERIOD_NS, SINGLE, TRIANGLE, WIDE, Arena, drive

FRAMES, START_S = 120, 1.5  # of each camera; robots accelerate during the first second
RADII_M = {"triangle": 0.5, "wide": 0.8, "single": 1.0}
ROBOTS = {"triangle": TRIANGLE, "wide": WIDE, "single": SINGLE}
STICK = Body(diameter_m=0.05, markers=((0.0, 0.0, 0.0), (0.5, 0.0, 0.0)))


@dataclass(frozen=True, slots=True)
class TrackingErrors:
    """RMS errors of position and of rotation, mean squared normalized error of both, and the tracked share."""

    position_mm: float
    rotation_mrad: float
    nees: float
    tracked: float


def frame_sets(arena: Arena, uses_rows: bool) -> Iterator[FrameSet]:
    """All frame sets; without `uses_rows` as if all rows were captured at the time of the middle one."""
    synchronizer = FrameSynchronizer(PERIOD_NS)
    for frame in arena.frames(FRAMES):
        synchronizer.add(frame if uses_rows else replace(frame, readout_s=0.0))
        yield from synchronizer.take(frame.t_ns)


def track_robots(readout_s: float, uses_rows: bool, speed_m_s: float, seed: int) -> TrackingErrors:
    """Track the robots, and compare with the truth."""
    motions = {name: drive(radius, speed_m_s) for name, radius in RADII_M.items()}
    arena = Arena(ROBOTS, motions, sigma_px=0.1, readout_s=readout_s, seed=seed)
    tracker = Tracker(arena.cameras, ROBOTS)
    position, rotation, nees, tracked = [], [], [], []
    for frame_set in frame_sets(arena, uses_rows):
        tracker.track(frame_set)
        if Arena.seconds(frame_set.t_ns) < START_S:
            continue
        for k, (name, robot) in enumerate(ROBOTS.items()):
            tracked.append(bool(tracker.table.tracked[k]))
            if not tracked[-1]:
                continue
            R, p = arena.truth(name, frame_set.t_ns)
            states, E = tracker.table.states, R.T @ tracker.table.states.R[k]
            turn = np.array([E[2, 1] - E[1, 2], E[0, 2] - E[2, 0], E[1, 0] - E[0, 1]]) / 2
            error = np.concatenate([turn, states.p[k] - p])
            position.append(error[3:] @ error[3:])
            if len(robot.markers) > 1:  # the rotation about a single marker's normal is unobservable
                rotation.append(turn @ turn)
                nees.append(error @ np.linalg.solve(states.P[k][:6, :6], error) / 6)
    return TrackingErrors(
        1e3 * float(np.sqrt(np.mean(position))),
        1e3 * float(np.sqrt(np.mean(rotation))),
        float(np.mean(nees)),
        float(np.mean(tracked)),
    )


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


def tracking_table(readout_s: float, speed_m_s: float, seeds: int) -> Table:
    """One row a kind of shutter and model, means over the seeds."""
    table = Table("shutter", "position mm", "rotation mrad", "normalized error", "tracked")
    cases = {
        "global": (0.0, True),
        f"{1e3 * readout_s:g} ms, row times ignored": (readout_s, False),
        f"{1e3 * readout_s:g} ms, row times used": (readout_s, True),
    }
    for name, (readout, uses_rows) in track(cases.items(), "tracking", len(cases)):
        rows = [track_robots(readout, uses_rows, speed_m_s, seed) for seed in range(1, seeds + 1)]
        table.add_row(
            name,
            f"{np.mean([row.position_mm for row in rows]):.2f}",
            f"{np.mean([row.rotation_mrad for row in rows]):.2f}",
            f"{np.mean([row.nees for row in rows]):.2f}",
            f"{np.mean([row.tracked for row in rows]):.1%}",
        )
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
            truth = np.array([recorded.truth.cameras[n].time_offset_ms for n in result.names])
            off = result.time_offset_ms - truth
            offsets.append(off - off.mean())
            squared, degrees = joint_error(result, recorded.truth)
            normalized.append((clock_error(result, recorded), squared / degrees))
            if result.readout_sigma_ms.any():
                readouts.append([result.readout_ms - readout, result.readout_sigma_ms])
        clocks, poses = np.mean(normalized, axis=0)
        table.add_row(
            name, *_readout_cells(np.array(readouts)), f"{_rms(offsets):.3f}", f"{clocks:.2f}", f"{poses:.2f}"
        )
    return table


def _readout_cells(readouts: Array) -> tuple[str, str]:
    if not readouts.size:
        return "none found", "-"
    error, sigma = np.moveaxis(readouts, 1, 0)
    return f"{_rms(error):.2f}", f"{np.mean((error / sigma) ** 2):.2f}"


def _rms(values: Array | list[Array]) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def main() -> None:
    """Print both tables."""
    parser = argparse.ArgumentParser(prog="tests.benchmarks.rolling_shutter")
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--readout-ms", type=float, default=30.0)
    parser.add_argument("--speed", type=float, default=2.0)
    options = parser.parse_args()
    console = Console(width=110)
    console.print(tracking_table(1e-3 * options.readout_ms, options.speed, options.seeds))
    console.print(calibration_table(options.readout_ms, options.seeds))


if __name__ == "__main__":
    main()
