# SPDX-License-Identifier: BSD-3-Clause
"""Turns the solution of a wand recording into the calibrated rig and its report."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import msgspec
import numpy as np

from calib.rig.camera import DRIFT, LENS, OFFSET, POSE, READOUT, Camera, transform
from calib.rig.camera_errors import ERRORS, as_pose_errors, with_errors
from calib.rig.estimation import rms
from calib.rig.rig import Rig
from calib.wand.alignment import Alignment, ClockMap
from calib.wand.bundle_adjustment.covariance import CameraCovariance, camera_covariance, parameter_sigma
from calib.wand.bundle_adjustment.problem import Adjusted, WandObservations, gauge_directions, scale_direction
from calib.wand.bundle_adjustment.residuals import point_residuals
from calib.wand.detections import WandRecording
from calib.wand.quality.checks import measure_lengths
from calib.wand.quality.lenses import find_lens_changes
from calib.wand.quality.wand_shape import WandShape, measure_shape
from calib.wand.scale import Distance, DistanceComparison
from calib.wand.wand_report import (
    BackgroundReport,
    CameraReport,
    ClockJump,
    Exchange,
    Outlier,
    Validation,
    WandCalibration,
    WandReport,
)
from calib.world.world_frame import move_rig, upright_frame
from camera_node.foundation.arrays import Array
from camera_node.geometry.pose import Pose, invert

CLOCK_UNITS = np.array([1e3, 1e6, 1e3])  # ms of an offset, ppm of a drift, ms of a readout time
MAX_POINTS = 500  # of the wand's path, for what its images do not tell apart


@dataclass(frozen=True, slots=True)
class Solution:
    """The adjusted rig, and its observations of the discs' own centres.

    Attributes:
        given: residuals of all detections of the recording, whether the adjustment used them or not.
        held_out: residuals of a fifth of the instants, at the rig adjusted without these.
        rejected_px: (r,) distances of the rejected observations from where the other cameras see the marker, pixels;
            NaN where none does.
    """

    adjusted: Adjusted
    observations: WandObservations
    given: Validation | None = None
    held_out: Validation | None = None
    rejected_px: Array | None = None


@dataclass(frozen=True, slots=True)
class Placement:
    """Which cameras the initial rig places, and how the scale is known.

    Attributes:
        recording: of the placed cameras.
        unplaced: the reason for each other camera.
        metric: whether the wand gives the scale.
        scaled_by: the measured distance that gives the scale.
        compared_with: a measured distance to compare with the wand.
        timing: whether cameras are taken as synchronous, and why.
        exchanges: cameras that show points of others, which were left out.
    """

    recording: WandRecording
    unplaced: dict[str, str]
    metric: bool
    scaled_by: Distance | None
    compared_with: Distance | None
    timing: str = ""
    exchanges: tuple[Exchange, ...] = ()


def conclude(rig: Rig, solution: Solution, placement: Placement, jump: ClockJump | None) -> WandCalibration:
    """Build the result: the rig in an upright world, clocks relative to their median, and the report."""
    adjusted, observations = solution.adjusted, solution.observations
    shape = measure_shape(adjusted)
    if placement.scaled_by is not None:
        adjusted = add_scale_uncertainty(adjusted, placement.scaled_by.sigma_m / placement.scaled_by.metres)
    elif shape is not None:
        size, sigma = shape.size
        adjusted = add_scale_uncertainty(adjusted.scaled(size), sigma)
    covariance = camera_covariance(adjusted)
    offsets, drift, readout = (adjusted.state.clocks * CLOCK_UNITS).T
    variances = np.einsum("cpcp->cp", covariance.of((*OFFSET, *DRIFT, *READOUT)))
    offset_sigma, drift_sigma, readout_sigma = (np.sqrt(variances) * CLOCK_UNITS).T
    offsets, drift = offsets - np.median(offsets), drift - drift.mean()
    size = 6 * len(placement.recording.names)
    return WandCalibration(
        rig=_place(rig, adjusted, covariance, placement, offsets),
        report=_build_report(replace(solution, adjusted=adjusted), covariance, placement, shape),
        names=placement.recording.names,
        adjusted=adjusted,
        observations=observations,
        covariance=covariance.of(POSE).reshape(size, size),
        time_offset_ms=offsets,
        time_sigma_ms=offset_sigma,
        drift_ppm=drift,
        drift_sigma_ppm=drift_sigma,
        readout_ms=readout + 1e3 * adjusted.problem.readout_s,
        readout_sigma_ms=readout_sigma,
        jump=jump,
    )


def with_aligned_clocks(result: WandCalibration, alignment: Alignment, start_s: float) -> WandCalibration:
    """The result of a recording with aligned stamps, for the stamps as they were: offsets at the alignment's reference
    and rates, which are stored for each camera, because offsets alone hold at one time only.

    Args:
        result: of the aligned stamps.
        alignment: of the clocks.
        start_s: first aligned stamp, seconds after the reference.
    """
    offset_s, rate, cameras = [], [], dict(result.rig.cameras)
    middle_s = result.adjusted.problem.middle_s + start_s
    for k, name in enumerate(result.names):
        found = alignment.maps.get(name, ClockMap(0.0, 0.0))
        fine_s, drift = result.time_offset_ms[k] * 1e-3, result.drift_ppm[k] * 1e-6
        offset_s.append(found.offset_s + fine_s + drift * (found.offset_s - middle_s))
        rate.append((1 + found.rate) * (1 + drift) - 1)
    offset_ms = 1e3 * (np.array(offset_s) - np.median(offset_s))
    for k, name in enumerate(result.names):
        cameras[name] = msgspec.structs.replace(
            cameras[name],
            time_offset_ms=float(offset_ms[k]),
            time_drift_ppm=1e6 * float(rate[k]),
            time_reference_ns=alignment.reference_ns,
        )
    return replace(
        result,
        rig=msgspec.structs.replace(result.rig, cameras=cameras),
        time_offset_ms=offset_ms,
        drift_ppm=1e6 * np.array(rate),
    )


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
    by_parameter = _pose_errors(adjusted, k, covariance.free)
    own = by_parameter @ covariance.joint[k, :, k] @ by_parameter.T
    camera = with_errors({"": camera}, own)[""]
    return msgspec.structs.replace(
        camera.with_parameters(lens.parameters),
        T_world_cam=Pose.from_matrix(state.cameras[k]),
        time_offset_ms=offset_ms,
        readout_us=readout_us,
        covariance=tuple(tuple(row) for row in covariance.of(POSE)[k, :, k].tolist()),
        lens_sigma=parameter_sigma(lens, camera.lens_sigma, lens_sigma),
    )


def _pose_errors(adjusted: Adjusted, k: int, free: tuple[int, ...]) -> Array:
    """(8, d) the errors of camera k that look like errors of its d free parameters, where the wand was."""
    state, count = adjusted.state, len(adjusted.state.motion)
    T, knots = state.cameras[k], np.linspace(0, count - 1, min(count, MAX_POINTS)).astype(int)
    points = transform(invert(T), state.motion[knots, 0].reshape(-1, 3))
    lens = state.lens(k, adjusted.problem.lenses[k])
    uv = lens.project(points)
    seen = points[((uv > 0) & (uv < [lens.width, lens.height])).all(axis=1)]
    return as_pose_errors(lens, seen, free)


def _place(
    rig: Rig, adjusted: Adjusted, covariance: CameraCovariance, placement: Placement, offset_ms: Array
) -> Rig:
    cameras = dict(rig.cameras)
    for name in placement.unplaced:
        cameras[name] = msgspec.structs.replace(cameras[name], T_world_cam=None, covariance=None, errors=None)
    for k, name in enumerate(placement.recording.names):
        cameras[name] = adjusted_camera(cameras[name], adjusted, covariance, k, float(offset_ms[k]))
    state, free = adjusted.state, covariance.free
    by_parameter = [_pose_errors(adjusted, k, free) for k in range(len(placement.recording.names))]
    joint = np.einsum("aip,apbq,bjq->aibj", by_parameter, covariance.joint, by_parameter)
    placed = {name: cameras[name] for name in placement.recording.names}
    cameras |= with_errors(placed, joint.reshape(ERRORS * len(placed), -1))
    T_world = upright_frame(state.cameras, state.motion[:, 0].reshape(-1, 3))
    return move_rig(msgspec.structs.replace(rig, cameras=cameras), T_world)


def _build_report(
    solution: Solution, covariance: CameraCovariance, placement: Placement, shape: WandShape | None
) -> WandReport:
    adjusted, observations = solution.adjusted, solution.observations
    names, distance = placement.recording.names, placement.compared_with
    lengths, cov = measure_lengths(adjusted, observations), covariance.of(POSE)
    return WandReport(
        cameras=[
            _report_camera(placement.recording, k, observations, adjusted, cov[k, :, k])
            for k in range(len(names))
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
        wand=shape.sentence() if shape else "",
        size_sigma=shape.size[1] if shape else 0.0,
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
    residual_px = rms(np.linalg.norm(errors, axis=1))
    return BackgroundReport(len(problem.background), len(used), float(1 - used.mean()), residual_px)


def _report_camera(
    recording: WandRecording, k: int, observations: WandObservations, adjusted: Adjusted, cov: Array
) -> CameraReport:
    mine = observations.camera == k
    used = mine & adjusted.used
    return CameraReport(
        name=recording.names[k],
        frames=len(np.unique(recording.detections.frame[recording.detections.camera == k])),
        frames_used=len(np.unique(observations.t_s[used])),
        observations=int(used.sum()),
        outliers=int((mine & ~adjusted.used).sum()),
        residual_px=rms(np.linalg.norm(adjusted.residuals[used], axis=1)),
        sigma_mm=float(np.sqrt(np.trace(cov[3:, 3:]) / 3)) * 1e3,
        left_out=dict(recording.left_out[k]),
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


def compare_distance(
    distance: Distance, names: Sequence[str], adjusted: Adjusted
) -> DistanceComparison | None:
    """Compare a measured distance with the adjusted poses; None if one of the two cameras is not placed.

    Args:
        distance: the measured one.
        names: of the adjusted cameras.
        adjusted: the adjustment.
    """
    if distance.a not in names or distance.b not in names:
        return None
    ends = [names.index(distance.a), names.index(distance.b)]
    first, second = adjusted.state.cameras[ends]
    gap = first[:3, 3] - second[:3, 3]
    length = float(np.linalg.norm(gap))
    J = np.concatenate([gap @ first[:3, :3], -gap @ second[:3, :3]]) / length
    cov = camera_covariance(adjusted).of(POSE)[np.ix_(ends, range(3, 6), ends, range(3, 6))].reshape(6, 6)
    return DistanceComparison(distance, length, float(np.sqrt(J @ cov @ J + distance.sigma_m**2)))


def add_scale_uncertainty(adjusted: Adjusted, sigma: float) -> Adjusted:
    """Add the uncertainty of the length that gave the scale, which the adjustment took as exact.

    The covariance S becomes S + s^2 g g', for the relative standard deviation s = `sigma` of the length and the
    derivative g of the cameras by the scale of the world, without its component along the gauge. In the information
    matrix this is a downdate of rank one (Sherman and Morrison).
    """
    relative = sigma / (adjusted.scale * adjusted.inflation**0.5)
    if relative == 0:
        return adjusted
    gauge = np.linalg.qr(gauge_directions(adjusted.state, adjusted.problem.free))[0]
    g = scale_direction(adjusted.problem, adjusted.state)
    weighted = adjusted.information @ g
    weighted -= gauge @ (gauge.T @ weighted)
    lost = np.outer(weighted, weighted) / (relative**-2 + g @ weighted)
    return replace(adjusted, information=adjusted.information - lost)
