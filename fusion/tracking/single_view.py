# SPDX-License-Identifier: BSD-3-Clause
"""Markers of nobody that one camera alone sees: where their size says, and the two ways that they may face.

A view by itself tells a range as well as a size is measured, and two normals as likely as each other. Errors of a size
last (blur, threshold), so nothing is gained by averaging: each instant speaks for itself. What has just appeared may be
a false detection, and is told after `CONFIRMED` instants.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from camera_node.arrays import Array, Index, Mask
from camera_node.detection.disc_pose import decompose
from fusion.model.camera_array import CameraArray
from fusion.model.observations import Assignments, DetectionTable
from fusion.tracking.estimator import AXIS_SIGMA_PX
from fusion.tracking.multiview import SPEED_M_S, Marker
from fusion.tracking.result import Told, followed_places
from fusion.tracking.unlabeled import UnlabeledMarkers

CONFIRMED = 3  # instants in which a camera saw it near where it was
FORGOTTEN_NS = 300_000_000  # without being seen
NOISE_PX = 2.0  # of a place, from instant to instant
REACH = 16.3  # chi-square with 3 degrees, one in a thousand: within it two markers may be the same
CROWD = 100  # free detections of an instant: where there are more, a texture is seen, or grouping has failed


@dataclass(frozen=True, slots=True, eq=False)
class _Spots:
    """Where cameras saw something free: camera (N,), xy (2, N), time (N,) ns, and in how many instants (N,) so far."""

    camera: Index
    xy: Array
    t_ns: NDArray[np.int64]
    count: Index


class SingleViewTracker:
    """Follows what single cameras see.

    Args:
        optics: the cameras.
        radii: (R,) of the markers in use; one that may be of several sizes is as far as each of them says.
    """

    def __init__(self, optics: CameraArray, radii: Array) -> None:
        self._optics, self._radii = optics, np.unique(radii)
        self._spots = _Spots(
            np.empty(0, np.intp), np.empty((2, 0)), np.empty(0, np.int64), np.empty(0, np.intp)
        )

    def complete(
        self,
        tracker: Told,
        t_ns: int,
        sightings: DetectionTable,
        matches: Assignments,
        free: UnlabeledMarkers,
    ) -> UnlabeledMarkers:
        """The markers of nobody that several cameras see, and then these; for the leading shard, which tells them."""
        if not tracker.shard.leads:
            return free
        untold = np.isfinite(sightings.xy[0]) & np.isfinite(sightings.axes_px[1])
        untold[np.concatenate([matches.sighting, *(marker.sightings for marker in free.markers)])] = False
        rows = np.flatnonzero(untold) if len(self._radii) else np.empty(0, np.intp)
        rows = rows if len(rows) <= CROWD else rows[:0]
        rows = rows[self._follow(t_ns, sightings.select(rows)) >= CONFIRMED]
        return free.joined(self._tell(tracker, sightings, rows, free)) if len(rows) else free

    def _tell(
        self, tracker: Told, sightings: DetectionTable, rows: Index, free: UnlabeledMarkers
    ) -> UnlabeledMarkers:
        """Those of the detections `rows` that can't be of another marker that is told, or of a robot's."""
        seen = sightings.select(rows)
        place, spread, normals = self._locate(seen)
        of_robots = followed_places(tracker)
        others = (
            np.concatenate([of_robots[0], free.position]),
            np.concatenate([of_robots[1], free.covariance]),
        )
        kept = np.flatnonzero(~_may_be(place, spread, *others).any(1))
        kept = kept[_best(place[kept], spread[kept], seen.camera[kept])]
        markers = [Marker(place[k], spread[k], rows[[k]], seen.camera[[k]], np.nan) for k in kept.tolist()]
        unknown = np.full((len(kept), 3), np.nan)
        return UnlabeledMarkers(markers, place[kept], spread[kept], unknown, unknown, normals[kept])

    def _follow(self, t_ns: int, seen: DetectionTable) -> Index:
        """(N,) in how many instants each was there, this one included."""
        last, now = self._spots, t_ns + np.rint(seen.tau * 1e9).astype(np.int64)
        focal = self._optics.focal[seen.camera]
        slowness = (
            seen.axes_px[0] / focal / (2 * self._radii[0]) if len(seen) else focal
        )  # one over its range
        age_s = np.abs(now[:, None] - last.t_ns) * 1e-9
        reach = SPEED_M_S * slowness[:, None] * age_s + NOISE_PX / focal[:, None]
        off = np.linalg.norm(seen.xy[:, :, None] - last.xy[:, None], axis=0)
        same = (seen.camera[:, None] == last.camera) & (off < reach)
        count = 1 + np.max(np.where(same, last.count, 0), axis=1, initial=0)
        old = ~np.isin(last.camera, seen.exposures.camera) & (t_ns - last.t_ns < FORGOTTEN_NS)
        self._spots = _Spots(
            np.concatenate([last.camera[old], seen.camera]),
            np.concatenate([last.xy[:, old], seen.xy], axis=1),
            np.concatenate([last.t_ns[old], now]),
            np.concatenate([last.count[old], count]),
        )
        return count

    def _locate(self, seen: DetectionTable) -> tuple[Array, Array, Array]:
        """Positions (N, 3), covariances (N, 3, 3) and both normals (N, 2, 3), in the world."""
        R = self._optics.R_cam_world[seen.camera].transpose(0, 2, 1)
        c, n = decompose(_conics(seen), 1.0)  # of a disc of radius 1
        places = np.einsum("nij,nkj->nki", R, c)[:, None] * self._radii[:, None, None]
        places = places.reshape(len(seen), -1, 3)  # by every radius, twice each
        mean = places.mean(1)
        off = places - mean[:, None]
        ray = mean / np.linalg.norm(mean, axis=1, keepdims=True)
        range2 = np.einsum("ni,ni->n", mean, mean)
        along = range2 * (AXIS_SIGMA_PX / seen.axes_px[0]) ** 2
        across = range2 * (seen.cov[0, 0] + seen.cov[1, 1]) / 2 / self._optics.focal[seen.camera] ** 2
        rays = ray[:, :, None] * ray[:, None]
        noise = along[:, None, None] * rays + across[:, None, None] * (np.eye(3) - rays)
        spread = noise + np.einsum("nki,nkj->nij", off, off) / places.shape[1]
        return self._optics.centres[seen.camera] + mean, spread, np.einsum("nij,nkj->nki", R, n)


def _conics(seen: DetectionTable) -> Array:
    """(N, 3, 3) Q with p^T Q p = 0 for outlines' points p = (x, y, 1), undistorted: the lens taken as affine there."""
    c, s = np.cos(seen.angle_rad), np.sin(seen.angle_rad)
    axes = np.array([[c, -s], [s, c]]) * seen.axes_px / 2  # half axes, pixels
    half = np.linalg.solve(seen.scale.transpose(2, 0, 1), axes.transpose(2, 0, 1))
    dual = np.empty((len(seen), 3, 3))
    m = np.column_stack([*seen.xy, np.ones(len(seen))])
    dual[:] = m[:, :, None] * m[:, None]
    dual[:, :2, :2] -= half @ half.transpose(0, 2, 1)
    return -np.asarray(np.linalg.inv(dual), float)


def _may_be(place: Array, spread: Array, position: Array, covariance: Array) -> Mask:
    """(N, K) whether places and positions are the same, by their covariances."""
    off = place[:, None] - position
    near = np.einsum("nki,nki->nk", off, off) < REACH * (
        np.einsum("nii->n", spread)[:, None] + np.einsum("kii->k", covariance)
    )
    n, k = np.nonzero(near)
    S, e = spread[n] + covariance[k], off[n, k]
    near[n, k] = np.einsum("pi,pi->p", e, np.linalg.solve(S, e[:, :, None])[:, :, 0]) < REACH
    return near


def _best(place: Array, spread: Array, camera: Index) -> Index:
    """Rows of which none may be another's that is known better, seen by another camera."""
    size = np.einsum("nii->n", spread)
    better = (size[:, None] > size) & (camera[:, None] != camera)
    return np.flatnonzero(~(better & _may_be(place, spread, place, spread)).any(1))
