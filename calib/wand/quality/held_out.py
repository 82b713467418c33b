# SPDX-License-Identifier: BSD-3-Clause
"""Residuals of detections at a given rig, each with its marker triangulated again: no motion prior, no wand length.

Detections that the rig was not adjusted to are held out: their residuals show how well it describes new ones.
"""

from dataclasses import dataclass

import numpy as np

from calib.wand.bundle_adjustment.problem import State
from calib.wand.bundle_adjustment.problem_setup import LabeledRecording
from calib.wand.report import Validation
from calib.wand.tracks import interpolate, intersect
from camera_node.foundation.arrays import Array, Index
from camera_node.geometry.lens import Lens

GROSS = 4.5  # standard deviations of the residuals: a larger one is a gross error, as in the adjustment
RAYLEIGH_MEDIAN = 1.1774  # in standard deviations of one coordinate


@dataclass(frozen=True, slots=True)
class TriangulatedResiduals:
    """Residuals of n detections; NaN where fewer than two cameras saw the marker.

    Attributes:
        pixels: (n, 2) observed minus predicted pixels.
        range_m: (n,) distances of the markers from their cameras.
        focal_px: (n,) focal lengths of the cameras.
    """

    pixels: Array
    range_m: Array
    focal_px: Array

    def summary(self) -> Validation | None:
        """The residuals of all, and of those without gross errors; None where no two cameras saw a marker at once."""
        known = np.isfinite(self.pixels).all(axis=1)
        if not known.any():
            return None
        norms, distance = np.linalg.norm(self.pixels[known], axis=1), self.range_m[known]
        fine = norms <= GROSS * np.median(norms) / RAYLEIGH_MEDIAN
        return Validation(
            count=len(norms),
            all_px=_rms(norms),
            gross=float((~fine).mean()),
            residual_px=_rms(norms[fine]),
            error_m=_rms((norms / self.focal_px[known] * distance)[fine]),
            range_m=float(np.median(distance)),
        )


def triangulated_residuals(recording: LabeledRecording, state: State) -> TriangulatedResiduals:
    """Triangulate the marker of each detection, robustly, from it and from the other cameras' detections at its true
    time, equal or interpolated.

    Args:
        recording: labeled detections of C cameras.
        state: poses, clocks and lenses of these cameras.
    """
    lenses = [state.lens(k, lens) for k, lens in enumerate(recording.lenses)]
    recording = recording.with_row_times(state.clocks[:, 2]).undistort_tracks(lenses)
    count = len(recording.detections)
    pixels, range_m, focal_px = np.full((count, 2), np.nan), np.full(count, np.nan), np.empty(count)
    for camera, lens in enumerate(lenses):
        rows, T = np.flatnonzero(recording.detections.camera == camera), state.cameras[camera]
        points = _triangulate_rows(recording, state, lens, camera, rows)
        pixels[rows] = recording.detections.uv[rows] - lens.project((points - T[:3, 3]) @ T[:3, :3])
        range_m[rows] = np.linalg.norm(points - T[:3, 3], axis=1)
        focal_px[rows] = (lens.fx + lens.fy) / 2
    return TriangulatedResiduals(pixels, range_m, focal_px)


def _triangulate_rows(
    recording: LabeledRecording, state: State, lens: Lens, camera: int, rows: Index
) -> Array:
    """Return (r, 3) the markers of one camera's detections, world; NaN where no other camera saw them."""
    detections = recording.detections.select(rows)
    since = detections.t_s - recording.middle_s
    xy = np.full((len(recording.lenses), len(rows), 2), np.nan)
    for other, tracks in enumerate(recording.tracks):
        offset, drift = state.clocks[camera, :2] - state.clocks[other, :2]
        stamp_s = detections.t_s + offset + drift * since
        xy[other] = interpolate(tracks, detections.label, stamp_s, recording.timing.gap_s)
    xy[camera] = lens.normalise(detections.uv)
    ray = np.concatenate([np.nan_to_num(xy), np.ones((*xy.shape[:2], 1))], axis=2)
    ray /= np.linalg.norm(ray, axis=2, keepdims=True)
    ray = np.einsum("cij,crj->cri", state.cameras[:, :3, :3], ray)
    return intersect(ray[:, None], state.cameras[:, :3, 3], np.isfinite(xy[:, None, :, 0]))[0][0]


def _rms(values: Array) -> float:
    return float(np.sqrt((values**2).mean()))
