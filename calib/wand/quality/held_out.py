# SPDX-License-Identifier: BSD-3-Clause
"""Residuals of detections at a given rig, each with its marker triangulated again: no motion prior, no wand length.

Detections that the rig was not adjusted to are held out: their residuals show how well it describes new ones.
"""

import numpy as np

from calib.wand.bundle_adjustment.problem import State
from calib.wand.bundle_adjustment.problem_setup import LabeledRecording
from calib.wand.result import Validation
from calib.wand.tracks import interpolate, intersect
from camera_node.arrays import Array, Index
from camera_node.geometry.lens import Lens

GROSS = 4.5  # standard deviations of the residuals: a larger one is a gross error, as in the adjustment
RAYLEIGH_MEDIAN = 1.1774  # in standard deviations of one coordinate


def validate(recording: LabeledRecording, state: State) -> Validation | None:
    """Measure the residuals of a recording at a rig; None where no two cameras saw a marker at once.

    Args:
        recording: labeled detections of C cameras.
        state: poses, clocks and lenses of these cameras.
    """
    residuals, points = triangulated_residuals(recording, state)
    known = np.isfinite(residuals).all(axis=1)
    if not known.any():
        return None
    norms, camera = np.linalg.norm(residuals[known], axis=1), recording.detections.camera[known]
    fine = norms <= GROSS * np.median(norms) / RAYLEIGH_MEDIAN
    distance = np.linalg.norm(points[known] - state.cameras[camera, :3, 3], axis=1)
    focal = np.array([(lens.fx + lens.fy) / 2 for lens in _lenses(recording, state)])[camera]
    return Validation(
        count=len(norms),
        all_px=_rms(norms),
        gross=float((~fine).mean()),
        residual_px=_rms(norms[fine]),
        error_m=_rms((norms / focal * distance)[fine]),
        range_m=float(np.median(distance)),
    )


def triangulated_residuals(recording: LabeledRecording, state: State) -> tuple[Array, Array]:
    """Triangulate the marker of each detection, robustly, from it and from the other cameras' detections at its true
    time, equal or interpolated.

    Returns:
        residuals: (n, 2) observed minus predicted pixels; NaN where fewer than two cameras saw the marker.
        points: (n, 3) markers, world.
    """
    lenses = _lenses(recording, state)
    recording = recording.undistort_tracks(lenses)
    residuals, points = (np.full((len(recording.detections), width), np.nan) for width in (2, 3))
    for camera, lens in enumerate(lenses):
        rows, T = np.flatnonzero(recording.detections.camera == camera), state.cameras[camera]
        points[rows] = _triangulate_rows(recording, state, lens, camera, rows)
        predicted = lens.project((points[rows] - T[:3, 3]) @ T[:3, :3])
        residuals[rows] = recording.detections.uv[rows] - predicted
    return residuals, points


def _triangulate_rows(
    recording: LabeledRecording, state: State, lens: Lens, camera: int, rows: Index
) -> Array:
    """Return (r, 3) the markers of one camera's detections, world; NaN where no other camera saw them."""
    detections = recording.detections.select(rows)
    since = detections.t_s - recording.middle_s
    xy = np.full((len(recording.lenses), len(rows), 2), np.nan)
    for other, tracks in enumerate(recording.tracks):
        offset, drift = state.clocks[camera] - state.clocks[other]
        stamp_s = detections.t_s + offset + drift * since
        xy[other] = interpolate(tracks, detections.label, stamp_s, recording.timing.gap_s)
    xy[camera] = lens.normalise(detections.uv)
    ray = np.concatenate([np.nan_to_num(xy), np.ones((*xy.shape[:2], 1))], axis=2)
    ray /= np.linalg.norm(ray, axis=2, keepdims=True)
    ray = np.einsum("cij,crj->cri", state.cameras[:, :3, :3], ray)
    return intersect(ray[:, None], state.cameras[:, :3, 3], np.isfinite(xy[:, None, :, 0]))[0][0]


def _lenses(recording: LabeledRecording, state: State) -> list[Lens]:
    return [state.lens(k, lens) for k, lens in enumerate(recording.lenses)]


def _rms(values: Array) -> float:
    return float(np.sqrt((values**2).mean()))
