# SPDX-License-Identifier: BSD-3-Clause
"""Locates unlabeled markers that only one camera sees: range from the apparent size, and two possible normals.

One view determines a range with the accuracy of the size, and two equally probable normals. Errors of a size persist
(blur, threshold), so averaging over frame sets would gain nothing: each frame set is evaluated by itself. A detection
that just appeared may be false; a marker is reported after `CONFIRMED` frame sets.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from camera_node.detection.disc_pose import decompose
from camera_node.foundation.arrays import Array, Index, Mask
from fusion.model.observations import CameraArray, DetectionTable
from fusion.tracking.gating import AXIS_SIGMA_PX, FORGET_NS, MAX_SPEED_M_S, POSITION_GATE
from fusion.tracking.rays import Marker
from fusion.tracking.unlabeled import UnlabeledMarkers

CONFIRMED = 3  # frame sets with a detection near its last position
NOISE_PX = 2.0  # of an image position between frame sets
MAX_UNASSIGNED = 100  # detections of a frame set; more come from a texture or a failed grouping


@dataclass(frozen=True, slots=True, eq=False)
class _Spots:
    """N unassigned detections: camera (N,), undistorted xy (2, N), time (N,) ns, and number of frame sets (N,)."""

    camera: Index
    xy: Array
    t_ns: NDArray[np.int64]
    count: Index


class SingleViewTracker:
    """Tracks what single cameras see.

    Args:
        cameras: cameras of the rig.
        radii: (R,) of the markers in use; with several radii the range covers all of them.
    """

    def __init__(self, cameras: CameraArray, radii: Array) -> None:
        self._cameras, self._radii = cameras, np.unique(radii)
        self._spots = _Spots(
            np.empty(0, np.intp), np.empty((2, 0)), np.empty(0, np.int64), np.empty(0, np.intp)
        )

    def confirm(self, t_ns: int, detections: DetectionTable, used: Index) -> Index:
        """Rows of detections outside `used` that a camera has seen in `CONFIRMED` frame sets."""
        usable = np.isfinite(detections.xy[0]) & np.isfinite(detections.axes_px[1])
        usable[used] = False
        rows = np.flatnonzero(usable) if len(self._radii) else np.empty(0, np.intp)
        rows = rows if len(rows) <= MAX_UNASSIGNED else rows[:0]
        return rows[self._count(t_ns, detections.select(rows)) >= CONFIRMED]

    def locate(self, detections: DetectionTable, rows: Index, known: tuple[Array, Array]) -> UnlabeledMarkers:
        """The markers of detections `rows` that are none of the known markers.

        Args:
            detections: of a frame set.
            rows: confirmed detections.
            known: positions (K, 3) and covariances (K, 3, 3) of the markers that are reported already.
        """
        seen = detections.select(rows)
        position, covariance, normals = self._decompose(seen)
        new = np.flatnonzero(~_may_coincide(position, covariance, *known).any(1))
        new = new[_best_known(position[new], covariance[new], seen.camera[new])]
        markers = [
            Marker(position[k], covariance[k], rows[[k]], seen.camera[[k]], np.nan) for k in new.tolist()
        ]
        unknown = np.full((len(new), 3), np.nan)
        return UnlabeledMarkers(markers, position[new], covariance[new], unknown, unknown, normals[new])

    def _count(self, t_ns: int, seen: DetectionTable) -> Index:
        """(N,) in how many frame sets each detection was seen, including this one."""
        last, now = self._spots, t_ns + np.rint(seen.tau * 1e9).astype(np.int64)
        focal = self._cameras.focal[seen.camera]
        # The image speed of the fastest marker is MAX_SPEED_M_S over the range.
        per_range = seen.axes_px[0] / focal / (2 * self._radii[0]) if len(seen) else focal
        age_s = np.abs(now[:, None] - last.t_ns) * 1e-9
        reach = MAX_SPEED_M_S * per_range[:, None] * age_s + NOISE_PX / focal[:, None]
        distance = np.linalg.norm(seen.xy[:, :, None] - last.xy[:, None], axis=0)
        same = (seen.camera[:, None] == last.camera) & (distance < reach)
        count = 1 + np.max(np.where(same, last.count, 0), axis=1, initial=0)
        is_silent = np.ones(len(self._cameras.names), bool)
        is_silent[seen.exposures.camera] = False
        old = is_silent[last.camera] & (t_ns - last.t_ns < FORGET_NS)
        self._spots = _Spots(
            np.concatenate([last.camera[old], seen.camera]),
            np.concatenate([last.xy[:, old], seen.xy], axis=1),
            np.concatenate([last.t_ns[old], now]),
            np.concatenate([last.count[old], count]),
        )
        return count

    def _decompose(self, seen: DetectionTable) -> tuple[Array, Array, Array]:
        """Positions (N, 3), covariances (N, 3, 3) and both normals (N, 2, 3), world frame."""
        R = self._cameras.R_cam_world[seen.camera].transpose(0, 2, 1)
        c, n = decompose(seen.conics(), 1.0)  # of a disc of radius 1
        positions = np.einsum("nij,nkj->nki", R, c)[:, None] * self._radii[:, None, None]
        positions = positions.reshape(len(seen), -1, 3)  # two for each radius, relative to the camera
        mean = positions.mean(1)
        off = positions - mean[:, None]
        ray = mean / np.linalg.norm(mean, axis=1, keepdims=True)
        range2 = np.einsum("ni,ni->n", mean, mean)
        along = range2 * (AXIS_SIGMA_PX / seen.axes_px[0]) ** 2
        across = range2 * seen.variance_px2 / self._cameras.focal[seen.camera] ** 2
        rays = ray[:, :, None] * ray[:, None]
        noise = along[:, None, None] * rays + across[:, None, None] * (np.eye(3) - rays)
        covariance = noise + np.einsum("nki,nkj->nij", off, off) / positions.shape[1]
        return self._cameras.centres[seen.camera] + mean, covariance, np.einsum("nij,nkj->nki", R, n)


def _may_coincide(a: Array, cov_a: Array, b: Array, cov_b: Array) -> Mask:
    """(N, K) whether positions a (N, 3) and b (K, 3) can be the same, by their covariances."""
    off = a[:, None] - b
    near = np.einsum("nki,nki->nk", off, off) < POSITION_GATE * (
        np.einsum("nii->n", cov_a)[:, None] + np.einsum("kii->k", cov_b)
    )
    n, k = np.nonzero(near)
    S, e = cov_a[n] + cov_b[k], off[n, k]
    near[n, k] = np.einsum("pi,pi->p", e, np.linalg.solve(S, e[:, :, None])[:, :, 0]) < POSITION_GATE
    return near


def _best_known(position: Array, covariance: Array, camera: Index) -> Index:
    """Rows that do not coincide with a marker of smaller covariance from another camera."""
    size = np.einsum("nii->n", covariance)
    better = (size[:, None] > size) & (camera[:, None] != camera)
    return np.flatnonzero(~(better & _may_coincide(position, covariance, position, covariance)).any(1))
