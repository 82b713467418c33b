# SPDX-License-Identifier: BSD-3-Clause
"""What an adjusted wave says: the rig, its covariances, and a report that a person can act on."""

from collections import Counter
from dataclasses import dataclass, replace
from typing import Any

import msgspec
import numpy as np

from calib.rig.camera import DRIFT, LENS, OFFSET, POSE
from calib.rig.rig import Rig
from calib.wand.bundle_adjustment.covariance import CameraCovariance, camera_covariance
from calib.wand.bundle_adjustment.lens_prior import parameter_sigma
from calib.wand.bundle_adjustment.optimizer import Adjusted
from calib.wand.bundle_adjustment.problem import State, WandObservations
from calib.wand.quality.clock_jump import ClockJump, find_jump
from calib.wand.quality.lengths import measure_lengths
from calib.wand.quality.lens_change import find_changes
from calib.wand.report import CameraReport, Outlier, WandReport
from calib.wand.scale import Distance, compare, loosen
from calib.wand.solution import Solution
from calib.world.world_frame import move_rig, upright_frame
from camera_node.arrays import Array
from camera_node.geometry.pose import Pose


@dataclass(frozen=True, slots=True)
class WandCalibration:
    """A rig with poses and covariances, what there is to say of it, and the adjustment.

    Attributes:
        rig, report: the result.
        names: of the C placed cameras, the order of all below.
        adjusted: the adjustment; `observations` are its rows.
        covariance: (6C, 6C) of all poses together, each in its camera's own frame, rotation then translation, the world
            being where the cameras are on average.
        time_offset_ms, time_sigma_ms: (C,) true time = stamp + offset in the middle of the recording, median 0; and
            standard deviations, 0 where the data want no offsets.
        drift_ppm, drift_sigma_ppm: (C,) by which offsets grow, microseconds a second, mean 0; likewise.
        jump: of the camera whose clock jumped while the wand was waved.
    """

    rig: Rig
    report: WandReport
    names: list[str]
    adjusted: Adjusted
    observations: WandObservations
    covariance: Array
    time_offset_ms: Array
    time_sigma_ms: Array
    drift_ppm: Array
    drift_sigma_ppm: Array
    jump: ClockJump | None

    def as_dict(self) -> dict[str, Any]:
        """For the `calibration` map of `rig.yaml`: the report, clocks where the data want any, and what the wave
        changed of the lenses."""
        columns = {
            "time_offset_ms": (self.time_offset_ms, self.time_sigma_ms),
            "drift_ppm": (self.drift_ppm, self.drift_sigma_ppm),
        }
        clocks = {what: self._by_camera(*column) for what, column in columns.items() if (column[1] > 0).any()}
        changes = find_changes(self.names, self.adjusted)
        lenses = {name: change.as_dict() for name, change in changes.items()}
        jump = {"clock_jump": {self.jump.camera: self.jump.as_dict()}} if self.jump else {}
        return {**self.report.as_dict(), **clocks, **jump, "adjusted_lenses": lenses}

    def _by_camera(self, values: Array, sigmas: Array) -> dict[str, dict[str, float]]:
        return {
            name: {"value": round(float(value), 4), "sigma": round(float(sigma), 4)}
            for name, value, sigma in zip(self.names, values, sigmas, strict=True)
        }


@dataclass(frozen=True, slots=True)
class Told:
    """What is known before the adjustment, in the order of `names`, the placed cameras: frames with the wand, frames
    left out by reason; the reason for each camera that is not placed; whether the scale is known; and the distance of
    two cameras that somebody measured, with whether the rig is `scaled` by it."""

    names: list[str]
    frames: list[int]
    left_out: list[Counter[str]]
    unplaced: dict[str, str]
    metric: bool
    distance: Distance | None = None
    scaled: bool = False


def conclude(rig: Rig, solution: Solution, told: Told) -> WandCalibration:
    """The rig in an upright world, and the report."""
    adjusted, count = solution.adjusted, len(told.names)
    if told.distance is not None and told.scaled:
        adjusted = loosen(adjusted, told.distance)
        solution = replace(solution, adjusted=adjusted)
    covariance = camera_covariance(adjusted)
    joint = covariance.of(POSE)
    offsets, offset_sigma = clock_values(adjusted.state, covariance, OFFSET, 1e3)
    drift, drift_sigma = clock_values(adjusted.state, covariance, DRIFT, 1e6)
    offsets, drift = offsets - np.median(offsets), drift - drift.mean()
    placed = _place(rig, solution, told, covariance, offsets)
    return WandCalibration(
        placed,
        _report(solution, told, joint),
        told.names,
        adjusted,
        solution.observations,
        joint.reshape(6 * count, 6 * count),
        offsets,
        offset_sigma,
        drift,
        drift_sigma,
        find_jump(told.names, adjusted, solution.observations),
    )


def clock_values(
    state: State, covariance: CameraCovariance, part: tuple[int, ...], unit: float
) -> tuple[Array, Array]:
    """Values and standard deviations (C,) of a clock's parameter."""
    values = state.clocks[:, part[0] - OFFSET[0]]
    sigma = np.sqrt(np.einsum("cpcp->c", covariance.of(part)))
    return values * unit, sigma * unit


def _place(rig: Rig, solution: Solution, told: Told, covariance: CameraCovariance, offset_ms: Array) -> Rig:
    state, cameras = solution.adjusted.state, dict(rig.cameras)
    joint, lens_sigma = covariance.of(POSE), np.sqrt(np.einsum("cpcp->cp", covariance.of(LENS)))
    for name in told.unplaced:
        cameras[name] = msgspec.structs.replace(cameras[name], T_world_cam=None, covariance=None)
    for k, name in enumerate(told.names):
        lens = state.lens(k, cameras[name])
        cameras[name] = msgspec.structs.replace(
            cameras[name],
            fx=lens.fx,
            fy=lens.fy,
            cx=lens.cx,
            cy=lens.cy,
            distortion=lens.distortion,
            T_world_cam=Pose.from_matrix(state.cameras[k]),
            time_offset_ms=float(offset_ms[k]),
            covariance=tuple(tuple(row) for row in joint[k, :, k].tolist()),
            lens_sigma=parameter_sigma(lens, cameras[name].lens_sigma, lens_sigma[k]),
        )
    T_world = upright_frame(state.cameras, state.motion[:, 0].reshape(-1, 3))
    return move_rig(msgspec.structs.replace(rig, cameras=cameras), T_world)


def _report(solution: Solution, told: Told, joint: Array) -> WandReport:
    adjusted, seen = solution.adjusted, solution.observations
    lengths = measure_lengths(adjusted, seen)
    return WandReport(
        cameras=[_report_camera(told, k, seen, adjusted, joint[k, :, k]) for k in range(len(told.names))],
        unplaced=told.unplaced,
        instants=len(adjusted.problem.knot_s),
        scale=adjusted.scale,
        length_mean_mm=float(np.mean(lengths)) * 1e3 if len(lengths) else None,
        length_std_mm=float(np.std(lengths)) * 1e3 if len(lengths) else None,
        outliers=_outliers(told.names, seen, adjusted),
        metric=told.metric or told.scaled,
        widened=adjusted.inflation**0.5,
        scaled_by=told.distance if told.scaled else None,
        compared=compare(told.distance, told.names, adjusted) if told.distance and not told.scaled else None,
    )


def _report_camera(
    told: Told, k: int, seen: WandObservations, adjusted: Adjusted, cov: Array
) -> CameraReport:
    mine = seen.camera == k
    used = mine & adjusted.used
    rms = float(np.sqrt((adjusted.residuals[used] ** 2).sum(axis=1).mean())) if used.any() else float("nan")
    return CameraReport(
        name=told.names[k],
        frames=told.frames[k],
        frames_used=len(np.unique(seen.t_s[used])),
        observations=int(used.sum()),
        outliers=int((mine & ~adjusted.used).sum()),
        residual_px=rms,
        sigma_mm=float(np.sqrt(np.trace(cov[3:, 3:]) / 3)) * 1e3,
        left_out=dict(told.left_out[k]),
    )


def _outliers(names: list[str], seen: WandObservations, adjusted: Adjusted) -> list[Outlier]:
    rows = np.flatnonzero(~adjusted.used)
    far = np.linalg.norm(adjusted.residuals, axis=1)
    return [
        Outlier(names[seen.camera[row]], float(seen.t_s[row]), int(seen.label[row]), float(far[row]))
        for row in rows[np.argsort(-far[rows])]
    ]
