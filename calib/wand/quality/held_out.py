# SPDX-License-Identifier: BSD-3-Clause
"""Residuals of detections at a given rig, each with its marker triangulated anew: no motion prior, no wand length.

Detections that the rig was not adjusted to are held out: their residuals show how well it describes new ones.
"""

import numpy as np

from calib.wand.bundle_adjustment.problem import State
from calib.wand.bundle_adjustment.problem_setup import LabeledRecording
from calib.wand.tracks import interpolate, intersect
from camera_node.arrays import Array, Index
from camera_node.geometry.lens import Lens


def triangulated_residuals(recording: LabeledRecording, state: State) -> Array:
    """Return (n, 2) observed minus predicted pixels of all detections; NaN where fewer than two cameras saw the marker.

    A detection's marker is triangulated from it and from the other cameras' detections at its true time, equal or
    interpolated.

    Args:
        recording: labeled detections of C cameras.
        state: the rig: poses, clocks and lenses of these cameras.
    """
    lenses = [state.lens(k, lens) for k, lens in enumerate(recording.lenses)]
    recording = recording.undistort_tracks(lenses)
    residuals = np.full((len(recording.detections), 2), np.nan)
    for camera in range(len(lenses)):
        rows = np.flatnonzero(recording.detections.camera == camera)
        points = _triangulate_rows(recording, state, lenses[camera], camera, rows)
        T = state.cameras[camera]
        predicted = lenses[camera].project((points - T[:3, 3]) @ T[:3, :3])
        residuals[rows] = recording.detections.uv[rows] - predicted
    return residuals


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
