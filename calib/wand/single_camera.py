# SPDX-License-Identifier: BSD-3-Clause
"""Recalibrates one camera of a rig, moved or new, from a short wand recording; the other cameras are fixed."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import msgspec
import numpy as np

from calib.errors import CalibrationError
from calib.rig.camera import LENS, OFFSET, POSE
from calib.rig.estimation import rms
from calib.rig.rig import Rig
from calib.wand.bundle_adjustment.covariance import camera_covariance, estimate_lens_priors
from calib.wand.bundle_adjustment.disc_centres import with_disc_centres
from calib.wand.bundle_adjustment.optimizer import adjust, optimize_robustly
from calib.wand.bundle_adjustment.problem import Adjusted, Estimate, WandObservations
from calib.wand.bundle_adjustment.problem_setup import build_problem
from calib.wand.calibrate import check_agreement
from calib.wand.clock_model import with_readout_times
from calib.wand.conclusion import Solution, adjusted_camera
from calib.wand.detections import WandRecording
from calib.wand.initial_rig import TwoViewGeometry
from calib.wand.labels import label_recording
from calib.wand.quality.checks import check_lenses
from calib.wand.recording_checks import check_recording
from camera_node.foundation.arrays import Array
from camera_node.geometry.body import Body
from camera_node.geometry.pose import invert, rotation_angle
from camera_node.protocol.messages import Detections

MAX_FRAME_SETS = 300


@dataclass(frozen=True, slots=True)
class Recalibration:
    """The rig with one recalibrated camera, and the adjustment.

    Attributes:
        rig: with the new camera; the other cameras are unchanged.
        name: of the camera.
        moved_mm, turned_deg: from its previous pose; None if it had none.
        residual_px: RMS distance of its observed from predicted centres.
        sigma_mm: standard deviation of its position along one axis, with exact other cameras.
        time_sigma_ms: standard deviation of its time offset.
        adjusted, observations: the adjustment and its observations.
    """

    rig: Rig
    name: str
    moved_mm: float | None
    turned_deg: float | None
    residual_px: float
    sigma_mm: float
    time_sigma_ms: float
    adjusted: Adjusted
    observations: WandObservations


def recalibrate_camera(
    rig: Rig, wand: Body, messages: Sequence[Detections], name: str, synchronous: bool = False
) -> Recalibration:
    """Estimate the pose, time offset and lens correction of one camera; all other cameras are fixed.

    Args:
        rig: intrinsics of the camera, and other cameras with poses and time offsets.
        wand: its markers.
        messages: detections of the camera and of others, in any order.
        name: of the camera.
        synchronous: frames with equal stamps are simultaneous, and the camera has no time offset.

    Raises:
        CalibrationError: the camera is not in the rig or the recording, its intrinsics are those of another camera, or
            no placed camera shares enough frame sets with it.
        CameraFault: its lens differs from its file, or its observations contradict those of the others.
    """
    recording = _label(rig, wand, messages, name, synchronous)
    this = recording.names.index(name)
    pairs = TwoViewGeometry(recording.detections, recording.lenses, wand, recording.timing)
    cameras, offset_s = _initial_rig(rig, recording.names, pairs, this)
    start = build_problem(recording, cameras, offset_s, MAX_FRAME_SETS)
    if start is None:
        raise CalibrationError("the wand's lengths do not fit the detections; check the wand file")
    solution = _adjust(recording, start, this)
    return _conclude(rig, name, this, solution)


def _label(
    rig: Rig, wand: Body, messages: Sequence[Detections], name: str, synchronous: bool
) -> WandRecording:
    """Label the detections of the camera and of all placed cameras."""
    if name not in rig.cameras:
        raise CalibrationError(
            f"camera '{name}' is not in the rig, which has {', '.join(sorted(rig.cameras))}; correct the name, or run "
            f"roundel calibrate intrinsics --camera {name}"
        )
    used = set(rig.placed()) | {name}
    messages = [message for message in messages if message.camera in used]
    check_recording(rig, messages)
    recording = label_recording(rig, wand, messages, synchronous)
    if name not in recording.names:
        raise CalibrationError(f"camera '{name}' is not in the recording, or never saw the wand")
    return recording


def _initial_rig(rig: Rig, names: list[str], pairs: TwoViewGeometry, this: int) -> tuple[Array, Array]:
    """Poses (C, 4, 4) and time offsets (C,) of all cameras: the rig's, and for the new camera from the two-view
    geometry with the camera that shares most frame sets with it."""
    shared = pairs.count_shared()[this]
    for other in np.argsort(-shared).tolist():
        if other == this or not shared[other]:
            continue
        pair = pairs.relate(other, this)
        if pair is None or not pair.metric:
            continue
        given = [rig.cameras[n] for n in names]
        cameras = np.array([np.eye(4) if k == this else c.matrix() for k, c in enumerate(given)])
        offset_s = np.array([c.time_offset_ms for c in given]) * 1e-3
        cameras[this] = cameras[other] @ pair.T_a_b
        offset_s[this] = offset_s[other] - pair.shift_s
        return cameras, offset_s
    counts = ", ".join(f"{shared[k]} with {n}" for k, n in enumerate(names) if k != this)
    raise CalibrationError(
        f"camera '{names[this]}' can't be placed: frame sets shared with placed cameras: {counts}; wave the wand where "
        "its view overlaps theirs"
    )


def _adjust(recording: WandRecording, start: Estimate, this: int) -> Solution:
    """Adjust the camera: robustly, with usual lens priors, and with estimated lens priors."""
    clock = () if recording.timing.synchronous else OFFSET
    problem = replace(start.problem.with_free(POSE, clock), estimated=(this,))
    state = optimize_robustly(problem, start.observations, start.state)
    observations = with_disc_centres(problem, state, start.observations, recording.wand)
    first = adjust(problem.with_free(POSE, clock, LENS), observations, state)
    first = with_readout_times(first, observations, recording.timing)
    check_lenses(recording.names, first)
    problem = estimate_lens_priors(first.problem, first)
    adjusted = adjust(problem, observations, first.state)
    check_agreement(recording.names, adjusted, observations)
    return Solution(adjusted, observations)


def _conclude(rig: Rig, name: str, this: int, solution: Solution) -> Recalibration:
    adjusted, observations, before = solution.adjusted, solution.observations, rig.cameras[name]
    covariance, T = camera_covariance(adjusted), adjusted.state.cameras[this]
    cov = covariance.of(POSE)[this, :, this]
    offset_ms = 1e3 * float(adjusted.state.clocks[this, 0])
    camera = adjusted_camera(before, adjusted, covariance, this, offset_ms)
    used = adjusted.used & (observations.camera == this)
    change = None if before.T_world_cam is None else invert(before.matrix()) @ T
    return Recalibration(
        rig=msgspec.structs.replace(rig, cameras={**rig.cameras, name: camera}),
        name=name,
        moved_mm=None if change is None else float(np.linalg.norm(change[:3, 3])) * 1e3,
        turned_deg=None if change is None else float(np.degrees(rotation_angle(change[:3, :3]))),
        residual_px=rms(np.linalg.norm(adjusted.residuals[used], axis=1)),
        sigma_mm=float(np.sqrt(np.trace(cov[3:, 3:]) / 3)) * 1e3,
        time_sigma_ms=1e3 * float(np.sqrt(covariance.of(OFFSET)[this, 0, this, 0])),
        adjusted=adjusted,
        observations=observations,
    )
