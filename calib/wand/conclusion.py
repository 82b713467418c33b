# SPDX-License-Identifier: BSD-3-Clause
"""Turns the solution of a wand recording into the calibrated rig and its report."""

from collections import Counter
from dataclasses import dataclass, replace

import msgspec
import numpy as np

from calib.rig.camera import DRIFT, LENS, OFFSET, POSE, READOUT, Camera
from calib.rig.rig import Rig
from calib.wand.adjustment import Solution
from calib.wand.bundle_adjustment.covariance import CameraCovariance, camera_covariance
from calib.wand.bundle_adjustment.eliminated_points import point_residuals
from calib.wand.bundle_adjustment.lens_prior import parameter_sigma
from calib.wand.bundle_adjustment.optimizer import Adjusted
from calib.wand.bundle_adjustment.problem import State, WandObservations
from calib.wand.quality.checks import measure_lengths
from calib.wand.quality.clock_jump import find_jump
from calib.wand.quality.lenses import find_lens_changes
from calib.wand.report import BackgroundReport, CameraReport, Exchange, Outlier, WandReport
from calib.wand.result import WandCalibration
from calib.wand.scale import Distance, add_scale_uncertainty, compare_distance
from calib.world.world_frame import move_rig, upright_frame
from camera_node.foundation.arrays import Array
from camera_node.geometry.pose import Pose


@dataclass(frozen=True, slots=True)
class Placement:
    """Which cameras the initial rig places, and how the scale is known.

    Attributes:
        names: of the placed cameras, the order of `frames` and `left_out`.
        frames: number of frames with the wand.
        left_out: number of frames without it, by reason.
        unplaced: the reason for each other camera.
        metric: whether the wand gives the scale.
        scaled_by: the measured distance that gives the scale.
        compared_with: a measured distance to compare with the wand.
        timing: whether cameras are taken as synchronous, and why.
        exchanges: cameras that show points of others, which were left out.
    """

    names: list[str]
    frames: list[int]
    left_out: list[Counter[str]]
    unplaced: dict[str, str]
    metric: bool
    scaled_by: Distance | None
    compared_with: Distance | None
    timing: str = ""
    exchanges: tuple[Exchange, ...] = ()


def conclude(rig: Rig, solution: Solution, placement: Placement) -> WandCalibration:
    """Build the result: the rig in an upright world, clocks relative to their median, and the report."""
    adjusted, observations = solution.adjusted, solution.observations
    if placement.scaled_by is not None:
        adjusted = add_scale_uncertainty(adjusted, placement.scaled_by)
    covariance = camera_covariance(adjusted)
    offsets, offset_sigma = clock_values(adjusted.state, covariance, OFFSET, 1e3)
    drift, drift_sigma = clock_values(adjusted.state, covariance, DRIFT, 1e6)
    readout, readout_sigma = clock_values(adjusted.state, covariance, READOUT, 1e3)
    offsets, drift = offsets - np.median(offsets), drift - drift.mean()
    size = 6 * len(placement.names)
    return WandCalibration(
        rig=_place(rig, adjusted, covariance, placement, offsets),
        report=_build_report(replace(solution, adjusted=adjusted), covariance, placement),
        names=placement.names,
        adjusted=adjusted,
        observations=observations,
        covariance=covariance.of(POSE).reshape(size, size),
        time_offset_ms=offsets,
        time_sigma_ms=offset_sigma,
        drift_ppm=drift,
        drift_sigma_ppm=drift_sigma,
        readout_ms=readout + 1e3 * adjusted.problem.readout_s,
        readout_sigma_ms=readout_sigma,
        jump=find_jump(placement.names, adjusted, observations),
    )


def clock_values(
    state: State, covariance: CameraCovariance, part: tuple[int, ...], unit: float
) -> tuple[Array, Array]:
    """Return values and standard deviations (C,) of a clock parameter, OFFSET, DRIFT or READOUT, times `unit`."""
    values = state.clocks[:, part[0] - OFFSET[0]]
    sigma = np.sqrt(np.einsum("cpcp->c", covariance.of(part)))
    return values * unit, sigma * unit


def adjusted_camera(
    camera: Camera, adjusted: Adjusted, covariance: CameraCovariance, k: int, offset_ms: float
) -> Camera:
    """Return the camera with the adjusted lens, pose and readout time of index k, their covariances, and a time
    offset."""
    state = adjusted.state
    lens, readout_us = state.lens(k, camera), camera.readout_us
    if READOUT[0] in adjusted.problem.free:
        readout_us = 1e6 * float(adjusted.problem.readout_s[k] + state.clocks[k, 2])
    lens_sigma = np.sqrt(np.diag(covariance.of(LENS)[k, :, k]))
    return msgspec.structs.replace(
        camera.with_parameters(lens.parameters),
        T_world_cam=Pose.from_matrix(state.cameras[k]),
        time_offset_ms=offset_ms,
        readout_us=readout_us,
        covariance=tuple(tuple(row) for row in covariance.of(POSE)[k, :, k].tolist()),
        lens_sigma=parameter_sigma(lens, camera.lens_sigma, lens_sigma),
    )


def _place(
    rig: Rig, adjusted: Adjusted, covariance: CameraCovariance, placement: Placement, offset_ms: Array
) -> Rig:
    cameras = dict(rig.cameras)
    for name in placement.unplaced:
        cameras[name] = msgspec.structs.replace(cameras[name], T_world_cam=None, covariance=None)
    for k, name in enumerate(placement.names):
        cameras[name] = adjusted_camera(cameras[name], adjusted, covariance, k, float(offset_ms[k]))
    state = adjusted.state
    T_world = upright_frame(state.cameras, state.motion[:, 0].reshape(-1, 3))
    return move_rig(msgspec.structs.replace(rig, cameras=cameras), T_world)


def _build_report(solution: Solution, covariance: CameraCovariance, placement: Placement) -> WandReport:
    adjusted, observations = solution.adjusted, solution.observations
    names, distance = placement.names, placement.compared_with
    lengths, cov = measure_lengths(adjusted, observations), covariance.of(POSE)
    return WandReport(
        cameras=[
            _report_camera(placement, k, observations, adjusted, cov[k, :, k]) for k in range(len(names))
        ],
        unplaced=placement.unplaced,
        wand_poses=len(adjusted.problem.knot_s),
        length_mean_mm=float(np.mean(lengths)) * 1e3 if len(lengths) else None,
        length_std_mm=float(np.std(lengths)) * 1e3 if len(lengths) else None,
        outliers=_list_outliers(names, solution),
        given=solution.given,
        held_out=solution.held_out,
        metric=placement.metric or placement.scaled_by is not None,
        sigma_inflation=adjusted.inflation**0.5,
        scaled_by=placement.scaled_by,
        compared=compare_distance(distance, names, adjusted) if distance else None,
        timing=placement.timing,
        adjusted_lenses={
            name: change.as_dict() for name, change in find_lens_changes(names, adjusted).items()
        },
        exchanges=list(placement.exchanges),
        background=_report_background(adjusted),
    )


def _report_background(adjusted: Adjusted) -> BackgroundReport | None:
    problem, used = adjusted.problem, adjusted.background_used
    if not len(used):
        return None
    errors = point_residuals(problem, adjusted.state)[used]
    rms = float(np.sqrt((errors**2).sum(axis=1).mean())) if used.any() else float("nan")
    return BackgroundReport(len(problem.background), len(used), float(1 - used.mean()), rms)


def _report_camera(
    placement: Placement, k: int, observations: WandObservations, adjusted: Adjusted, cov: Array
) -> CameraReport:
    mine = observations.camera == k
    used = mine & adjusted.used
    rms = float(np.sqrt((adjusted.residuals[used] ** 2).sum(axis=1).mean())) if used.any() else float("nan")
    return CameraReport(
        name=placement.names[k],
        frames=placement.frames[k],
        frames_used=len(np.unique(observations.t_s[used])),
        observations=int(used.sum()),
        outliers=int((mine & ~adjusted.used).sum()),
        residual_px=rms,
        sigma_mm=float(np.sqrt(np.trace(cov[3:, 3:]) / 3)) * 1e3,
        left_out=dict(placement.left_out[k]),
    )


def _list_outliers(names: list[str], solution: Solution) -> list[Outlier]:
    """The rejected observations, farthest first, with their distance from where the other cameras see the marker."""
    observations, adjusted = solution.observations, solution.adjusted
    rows = np.flatnonzero(~adjusted.used)
    distance = np.linalg.norm(adjusted.residuals, axis=1)
    if solution.rejected_px is not None:
        distance[rows] = np.where(np.isfinite(solution.rejected_px), solution.rejected_px, distance[rows])
    return [
        Outlier(
            names[observations.camera[row]],
            float(observations.t_s[row]),
            int(observations.label[row]),
            float(distance[row]),
        )
        for row in rows[np.argsort(-distance[rows])]
    ]
