# SPDX-License-Identifier: BSD-3-Clause
"""Locates the wand in the latest frames of placed cameras, to show it during a recording."""

from collections.abc import Mapping, Sequence
from itertools import product

import numpy as np

from calib.errors import CalibrationError
from calib.rig.camera import Camera
from calib.rig.triangulation import triangulate_point
from calib.wand.detections import MAX_SPREAD_S, Timing, WandDetections, gather
from calib.wand.labels import label
from camera_node.foundation.arrays import Array
from camera_node.geometry.body import Body
from camera_node.protocol.messages import Detections

# Of a distance between two markers: the motion between frames changes it, a wrong match much more
MAX_MISFIT = 0.2
MAX_CAMERAS = 4  # that locate a wand of two markers: each one doubles the number of correspondences
ONE_FRAME = Timing(0.0, synchronous=True)  # labels need no other frames


def locate_wand(cameras: Mapping[str, Camera], wand: Body, latest: Mapping[str, Detections]) -> Array | None:
    """Locate the markers of the wand.

    The frames of different cameras are treated as simultaneous: at 1 m/s and 30 frames/s, the position is right to
    about 2 cm, which suffices for a display.

    Args:
        cameras: placed cameras by name.
        wand: its markers. Which end of a wand of two markers is which is unknown, unless they have numbers.
        latest: the latest frame of each camera, by name.

    Returns:
        (M, 3) world, metres, NaN for markers that fewer than two cameras saw; None if the wand is not seen.
    """
    newest_ns = max((message.t_ns for message in latest.values()), default=0)
    recent = [
        message
        for name, message in latest.items()
        if name in cameras and len(message) and newest_ns - message.t_ns < MAX_SPREAD_S * 1e9
    ]
    if len(recent) < 2:
        return None
    names = sorted(message.camera for message in recent)
    lenses = [cameras[name] for name in names]
    frames, detections = gather(recent, names, lenses, wand.codes)
    if len(wand.markers) == 2 and not (detections.label >= 0).any():
        return _locate_two(lenses, detections, wand)
    try:
        labeled, _ = label(frames, ONE_FRAME, detections, wand, lenses)
    except CalibrationError:  # a symmetric wand without numbers
        return None
    points = np.full((len(wand.markers), 3), np.nan)
    for marker in range(len(points)):
        rows = labeled.label == marker
        if rows.sum() >= 2:
            points[marker] = _triangulate([lenses[k] for k in labeled.camera[rows]], labeled.uv[rows])
    return points if _fits(points, wand.points) else None


def _locate_two(lenses: Sequence[Camera], detections: WandDetections, wand: Body) -> Array | None:
    """Locate a wand of two markers that look alike, by the correspondence of its ends that has the smallest residual.

    Returns:
        (2, 3) world, in any order; None if no two cameras see just two roundels, or if these are not a wand apart.
    """
    pairs = [np.flatnonzero(detections.camera == k) for k in range(len(lenses))]
    seen = [(lenses[k], detections.uv[rows]) for k, rows in enumerate(pairs) if len(rows) == 2][:MAX_CAMERAS]
    if len(seen) < 2:
        return None
    cameras, ends = [camera for camera, _ in seen], np.stack([uv for _, uv in seen])
    best, least = None, np.inf
    for swaps in product((0, 1), repeat=len(seen) - 1):
        ordered = np.stack([uv[::-1] if swap else uv for uv, swap in zip(ends, (0, *swaps), strict=True)])
        points = np.stack([_triangulate(cameras, ordered[:, end]) for end in (0, 1)])
        residual = _residual_px(cameras, points, ordered)
        if residual < least:
            best, least = points, residual
    return best if best is not None and _fits(best, wand.points) else None


def _residual_px(cameras: Sequence[Camera], points: Array, uv: Array) -> float:
    """RMS distance of pixels (N, 2, 2) of N cameras from the images of two points; infinite behind a camera."""
    images = np.stack([camera.project_world(points) for camera in cameras])
    residual = float(np.sqrt(np.mean((images - uv) ** 2)))
    return residual if np.isfinite(residual) else np.inf


def _triangulate(cameras: list[Camera], uv: Array) -> Array:
    try:
        return triangulate_point(cameras, uv)
    except CalibrationError:
        return np.full(3, np.nan)


def _fits(points: Array, body: Array) -> bool:
    """Whether some points (M, 3) were located, and their distances are about those of the body (M, 3)."""
    found = np.isfinite(points[:, 0])
    if not found.any():
        return False
    apart, true = (np.linalg.norm(p[found][:, None] - p[found], axis=2) for p in (points, body))
    return bool((np.abs(apart - true) <= MAX_MISFIT * true).all())
