# SPDX-License-Identifier: BSD-3-Clause
"""Points beside the wand, at unknown positions, that several cameras see: matched in time.

They may stand still or move, and constrain the cameras where the wand is not waved ("unpaired" or background points of
easyWand and Argus).
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from calib.errors import CalibrationError
from calib.rig.camera import Camera
from calib.wand.detections import WandDetections, gather
from calib.wand.tracks import SAME_S, MarkerTrack
from camera_node.foundation.arrays import Array, Index
from camera_node.protocol.messages import Detections

STILL = 3.0  # standard deviations of one detection: the images of a point that stands still differ by less
# Part of the error of a detection that is the same in all images of a point that stands still.
STILL_SIGMA_PX = 0.05
MAX_POINTS = 2000  # positions of points that are used


@dataclass(frozen=True, slots=True)
class BackgroundPoints:
    """Images of J points at unknown positions, at most one a camera and point, sorted by point, then by camera.

    Attributes:
        point, camera: (n,) numbers, from 0.
        uv: (n, 2) raw pixels.
        cov: (n, 2, 2) their covariance, square pixels.
    """

    point: Index
    camera: Index
    uv: Array
    cov: Array

    def __len__(self) -> int:
        """The number of points."""
        return int(self.point[-1]) + 1 if len(self.point) else 0

    @classmethod
    def none(cls) -> "BackgroundPoints":
        """No points."""
        nothing = np.zeros(0, np.intp)
        return cls(nothing, nothing, np.zeros((0, 2)), np.zeros((0, 2, 2)))

    def select(self, rows: NDArray) -> "BackgroundPoints":
        """The rows (n,) that a mask selects, with the points renumbered."""
        point = np.unique(self.point[rows], return_inverse=True)[1]
        return BackgroundPoints(point, self.camera[rows], self.uv[rows], self.cov[rows])


def gather_background(
    messages: Sequence[Detections], names: Sequence[str], lenses: Sequence[Camera], start_ns: int
) -> WandDetections | None:
    """Collect the images of background points as columns, with times in seconds after `start_ns`; the `id` of a
    detection is the number of its point. Cameras that are not among `names` are left out; None without any image.

    Raises:
        CalibrationError: detections have no numbers.
    """
    mine = [m for m in messages if m.camera in set(names) and len(m)]
    if not mine:
        return None
    first_ns = min(message.t_ns for message in mine)
    detections = gather(mine, names, lenses)[1]
    if (detections.label < 0).any():
        raise CalibrationError(
            "background points need numbers that are the same in all cameras: fill the column marker of their table"
        )
    return replace(detections, t_s=detections.t_s + (first_ns - start_ns) * 1e-9)


def match_points(detections: WandDetections, true_s: Array, gap_s: float) -> BackgroundPoints:
    """Match images of the same position of a point in several cameras.

    A point that stands still has one position, and its images in a camera are averaged. One that moves has a position
    at each of its times; images between two frames are interpolated.

    Args:
        detections: n images of background points.
        true_s: (n,) true capture times.
        gap_s: the longest time over which images are interpolated; 0 if only frames of equal time are simultaneous.
    """
    groups = [
        group for rows in _by_number(detections.label) for group in _match(detections, true_s, rows, gap_s)
    ]
    if len(groups) > MAX_POINTS:
        groups = [groups[k] for k in np.linspace(0, len(groups) - 1, MAX_POINTS).astype(int)]
    if not groups:
        return BackgroundPoints.none()
    point = np.repeat(np.arange(len(groups)), [len(group.camera) for group in groups])
    return BackgroundPoints(
        point, *(np.concatenate([getattr(g, name) for g in groups]) for name in ("camera", "uv", "cov"))
    )


def _by_number(label: Index) -> list[Index]:
    """The rows of each number."""
    order = np.argsort(label, kind="stable")
    return np.split(order, np.flatnonzero(np.diff(label[order])) + 1)


def _match(
    detections: WandDetections, true_s: Array, rows: Index, gap_s: float
) -> Iterator[BackgroundPoints]:
    """The images of each position of one point, whose detections are `rows`, in two cameras or more."""
    cameras = np.unique(detections.camera[rows]).tolist()
    if len(cameras) < 2:
        return
    of_camera = [rows[detections.camera[rows] == camera] for camera in cameras]
    if all(_stands_still(detections, mine) for mine in of_camera):
        images = [_average(detections, mine) for mine in of_camera]
        yield _one_point(cameras, np.array([uv for uv, _ in images]), np.array([cov for _, cov in images]))
        return
    # Where frames of equal time exist, every time counts; else those of the camera that saw the point most often.
    times = np.unique(true_s[rows]) if gap_s == 0 else np.sort(true_s[max(of_camera, key=len)])
    uv = np.array([_interpolate(detections, true_s, mine, times, gap_s) for mine in of_camera])
    cov = np.array([np.median(detections.cov[mine], axis=0) for mine in of_camera])
    known = np.isfinite(uv[:, :, 0])
    for k in np.flatnonzero(known.sum(axis=0) >= 2).tolist():
        seen = known[:, k]
        yield _one_point(np.array(cameras)[seen].tolist(), uv[seen, k], cov[seen])


def _one_point(cameras: list[int], uv: Array, cov: Array) -> BackgroundPoints:
    return BackgroundPoints(np.zeros(len(cameras), np.intp), np.array(cameras), uv, cov)


def _stands_still(detections: WandDetections, rows: Index) -> bool:
    uv, variance = detections.uv[rows], np.median(np.einsum("nii->n", detections.cov[rows])) / 2
    away = uv - np.median(uv, axis=0)
    return bool(np.median((away**2).sum(axis=1)) <= 2 * STILL**2 * variance)


def _average(detections: WandDetections, rows: Index) -> tuple[Array, Array]:
    """The median of the images of a point that stands still, which one of many that are wrong does not change, and its
    covariance: pi / 2 that of the mean."""
    cov = np.median(detections.cov[rows], axis=0) * (np.pi / 2 if len(rows) > 2 else 1.0) / len(rows)
    return np.median(detections.uv[rows], axis=0), cov + STILL_SIGMA_PX**2 * (len(rows) > 1) * np.eye(2)


def _interpolate(detections: WandDetections, true_s: Array, rows: Index, times: Array, gap_s: float) -> Array:
    """(k, 2) images at `times` (k,) of a point in one camera; NaN where it did not see the point about that time."""
    order = rows[np.argsort(true_s[rows], kind="stable")]
    fresh = np.diff(true_s[order], prepend=-np.inf) > SAME_S  # two images at once are no track
    order = order[fresh]
    return MarkerTrack.of(true_s[order], detections.uv[order]).interpolate(times, gap_s)
