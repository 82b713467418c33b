# SPDX-License-Identifier: BSD-3-Clause
"""One camera against a rig in force: somebody touched it, or it is new. A short wave, and the others stay."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import msgspec
import numpy as np

from calib.errors import CalibrationError
from calib.rig.camera import LENS, OFFSET, POSE
from calib.rig.rig import Rig
from calib.wand.bundle_adjustment.covariance import camera_covariance, inflate_covariance
from calib.wand.bundle_adjustment.disc_centres import with_disc_centres
from calib.wand.bundle_adjustment.lens_prior import estimate_lens_priors, parameter_sigma
from calib.wand.bundle_adjustment.optimizer import Adjusted, adjust, optimize_robustly
from calib.wand.bundle_adjustment.problem import WandObservations
from calib.wand.calibrate import check_recording, gather_wave, read
from calib.wand.initialization.two_view import TwoViewGeometry
from calib.wand.outcome import clock_values
from calib.wand.quality.checks import check_agreement, check_lenses
from camera_node.arrays import Array
from camera_node.geometry.body import Body
from camera_node.geometry.pose import Pose, invert
from camera_node.protocol.messages import Detections

MOMENTS = 300  # of the wave, that are used


@dataclass(frozen=True, slots=True)
class Recalibration:
    """The rig with one camera placed anew, and the adjustment.

    Attributes:
        rig: the other cameras are as they were.
        name: the camera.
        moved_mm, turned_deg: from where it stood; None where it stood nowhere.
        residual_px: RMS distance of seen from expected centres, of this camera.
        sigma_mm: expected error of its position along one axis, the others taken as known.
        time_sigma_ms: standard deviation of its time offset.
        adjusted, observations: the adjustment and its rows.
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


def place_one(rig: Rig, wand: Body, messages: Sequence[Detections], name: str) -> Recalibration:
    """Place camera `name` of a rig by a wand that it and placed cameras saw, and adjust its lens within what is known
    of it; all others stay.

    Args:
        rig: intrinsics of `name`, and other cameras with poses and time offsets.
        wand: its markers.
        messages: detections of `name` and of others, any order.

    Raises:
        CalibrationError: the camera or its intrinsics are missing or another's, or no placed camera saw enough with it.
    """
    if name not in rig.cameras:
        raise CalibrationError(
            f"camera '{name}' is not in the rig; run python -m calib intrinsics --camera {name}"
        )
    placed = set(rig.placed()) - {name}
    messages = [message for message in messages if message.camera in placed | {name}]
    check_recording(rig, messages)
    recording = read(rig, wand, messages)
    if name not in recording.names:
        raise CalibrationError(f"camera '{name}' is not in the recording, or never saw the wand")
    this = recording.names.index(name)
    pairs = TwoViewGeometry(recording.seen, recording.lenses, wand, recording.frames.period_s())
    cameras, offset_s = _start(rig, recording.names, pairs, this)
    wave = gather_wave(recording, pairs, wand, list(range(len(recording.names))))
    found = wave.pose_problem(cameras, offset_s, MOMENTS)
    if found is None:
        raise CalibrationError("the wand's lengths do not fit what the cameras saw: is the wand file right?")
    problem, state, observations = found
    problem = replace(problem.with_free(POSE, OFFSET), estimated=(this,))
    state = optimize_robustly(problem, observations, state)
    observations = with_disc_centres(problem, state, observations, wand.diameter_m)
    first = inflate_covariance(adjust(problem.with_free(POSE, OFFSET, LENS), observations, state))
    check_lenses(recording.names, first)
    adjusted = inflate_covariance(
        adjust(estimate_lens_priors(first.problem, first), observations, first.state)
    )
    check_agreement(recording.names, adjusted, observations)
    return _conclude(rig, name, this, adjusted, observations)


def _start(rig: Rig, names: list[str], pairs: TwoViewGeometry, this: int) -> tuple[Array, Array]:
    """Poses and time offsets of all cameras; of the one that is sought, by the camera that shares most with it."""
    shared = pairs.shared()[this]
    for other in np.argsort(-shared).tolist():
        if (
            other == this
            or not shared[other]
            or (pair := pairs.relate(other, this)) is None
            or not pair.metric
        ):
            continue
        known = [rig.cameras[n] for n in names]
        cameras = np.array([np.eye(4) if k == this else c.matrix() for k, c in enumerate(known)])
        offset_s = np.array([c.time_offset_ms for c in known]) * 1e-3
        cameras[this] = cameras[other] @ pair.T_a_b
        offset_s[this] = offset_s[other] - pair.shift_s
        return cameras, offset_s
    told = ", ".join(f"{shared[k]} with {n}" for k, n in enumerate(names) if k != this)
    raise CalibrationError(
        f"camera '{names[this]}' can't be placed: instants shared with placed cameras: {told}; "
        "wave where its view overlaps theirs"
    )


def _conclude(rig: Rig, name: str, this: int, adjusted: Adjusted, seen: WandObservations) -> Recalibration:
    before, T = rig.cameras[name], adjusted.state.cameras[this]
    covariance = camera_covariance(adjusted)
    cov = covariance.of(POSE)[this, :, this]
    offset_ms, sigma_ms = (column[this] for column in clock_values(adjusted.state, covariance, OFFSET, 1e3))
    lens_sigma = np.sqrt(np.diag(covariance.of(LENS)[this, :, this]))
    lens = adjusted.state.lens(this, before)
    camera = msgspec.structs.replace(
        before.with_parameters(lens.parameters),
        T_world_cam=Pose.from_matrix(T),
        time_offset_ms=float(offset_ms),
        covariance=tuple(tuple(row) for row in cov.tolist()),
        lens_sigma=parameter_sigma(lens, before.lens_sigma, lens_sigma),
    )
    used = adjusted.used & (seen.camera == this)
    change = None if before.T_world_cam is None else invert(before.matrix()) @ T
    return Recalibration(
        msgspec.structs.replace(rig, cameras={**rig.cameras, name: camera}),
        name,
        None if change is None else float(np.linalg.norm(change[:3, 3])) * 1e3,
        None if change is None else float(np.degrees(np.arccos(np.clip((np.trace(change) - 2) / 2, -1, 1)))),
        float(np.sqrt((adjusted.residuals[used] ** 2).sum(axis=1).mean())),
        float(np.sqrt(np.trace(cov[3:, 3:]) / 3)) * 1e3,
        float(sigma_ms),
        adjusted,
        seen,
    )
