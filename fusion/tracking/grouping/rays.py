# SPDX-License-Identifier: BSD-3-Clause
"""Viewing rays of detections, and the points at which several of them meet."""

from dataclasses import dataclass, fields, replace

import numpy as np

from camera_node.arrays import Array, Index
from fusion import _core
from fusion.model.camera_array import CameraArray, Exposures
from fusion.model.observations import DetectionTable
from fusion.tracking.gating import DIAMETER_TOLERANCE, MAX_SPEED_M_S

SIGMAS = 3.5
RAY_SLACK_PX = 0.5  # error of the calibration, and of an outline's centre as the centre of the disc
FAR_M = 50.0  # largest range of a ray without a size


@dataclass(frozen=True, slots=True, eq=False)
class Rays:
    """Viewing rays of N detections of one frame set.

    Attributes:
        o, d: (N, 3) origins and unit directions, world frame.
        sigma: (N,) noise of the direction, rad.
        size: (N,) diameter per metre of range; NaN where unknown.
        tau: (N,) capture time minus the time of the frame set, seconds.
        frame, camera: (N,) indices.
        exposures, centres: of all frames, and (C, 3) of all cameras.
        ranges: (N, K, 2) smallest and largest range at which the size suits each of K marker diameters.
    """

    o: Array
    d: Array
    sigma: Array
    size: Array
    tau: Array
    frame: Index
    camera: Index
    ranges: Array
    exposures: Exposures
    centres: Array

    def __len__(self) -> int:
        return len(self.d)

    def select(self, rows: Index) -> "Rays":
        """Some of the rays."""
        whole = ("exposures", "centres")
        by_ray = {f.name: getattr(self, f.name)[rows] for f in fields(self) if f.name not in whole}
        return Rays(**by_ray, exposures=self.exposures, centres=self.centres)

    @property
    def viewpoints(self) -> _core.Viewpoints:
        """The frames for the native core."""
        return _core.Viewpoints(self.exposures.camera, self.centres)

    def at_rest(self) -> "Rays":
        """The same rays for markers that do not move: as if all were of the time of the frame set."""
        return replace(self, tau=np.zeros(len(self)))

    @property
    def moved(self) -> Array:
        """(N,) how far the fastest marker moves between the time of the frame set and that of the ray, metres."""
        return MAX_SPEED_M_S * self.tau

    @property
    def reach(self) -> Array:
        """(N,) largest distance from a point on the ray, per metre of range."""
        return SIGMAS * self.sigma


def rays_of(cameras: CameraArray, detections: DetectionTable, rows: Index, diameters: Array) -> Rays:
    """The rays of some detections; see `find_markers`."""
    seen = detections.select(rows)
    camera, d = seen.camera, cameras.rays(seen.camera, seen.xy)
    noise = np.sqrt((seen.cov[0, 0] + seen.cov[1, 1]) / 2 + RAY_SLACK_PX**2)
    focal = cameras.focal[camera]
    depth = 1 / np.sqrt(1 + seen.xy[0] ** 2 + seen.xy[1] ** 2)  # per metre of range
    size = seen.axes_px[0] * depth / focal
    at = seen.exposures, cameras.centres
    ranges = _possible_ranges(size, diameters)
    return Rays(
        cameras.centres[camera], d, noise * depth / focal, size, seen.tau, seen.frame, camera, ranges, *at
    )


def _possible_ranges(size: Array, diameters: Array) -> Array:
    """(N, K, 2) smallest and largest range of rays with this size (N,), for each of the diameters (K,)."""
    tolerance = np.array([-DIAMETER_TOLERANCE, DIAMETER_TOLERANCE])
    ranges = diameters[:, None] * (1 + tolerance) / size[:, None, None]
    ranges[np.isnan(size)] = 0, FAR_M
    return ranges


def triangulate(rays: Rays, group: Index, near: Array) -> tuple[Array, Array]:
    """(K, 3) positions of the markers of K groups at the time of the frame set, and covariances (K, 3, 3).

    The ray of time tau passes p + tau v. Least squares give p and the velocity v of each group, whose prior has the
    standard deviation `MAX_SPEED_M_S` / `SIGMAS` in each direction. The weights follow from the noise at the range of
    `near` (K, 3).
    """
    rows = np.flatnonzero(group >= 0)
    k, o, d = group[rows], rays.o[rows], rays.d[rows]
    range_m, tau = np.einsum("ni,ni->n", near[k] - o, d), rays.tau[rows]
    weight = 1 / (rays.sigma[rows] * range_m) ** 2
    across = weight * (np.eye(3)[:, :, None] - d.T[:, None] * d.T)
    side = np.einsum("ijn,nj->in", across, o)
    of_p, of_pv, of_v = (_sums(across * tau**power, k, len(near)) for power in range(3))
    gain = of_pv @ np.linalg.inv(of_v + (SIGMAS / MAX_SPEED_M_S) ** 2 * np.eye(3))
    right = _sums(side, k, len(near)) - (gain @ _sums(side * tau, k, len(near))[:, :, None])[:, :, 0]
    covariance = np.asarray(np.linalg.inv(of_p - gain @ of_pv + 1e-9 * np.eye(3)), float)
    return np.einsum("nij,nj->ni", covariance, right), covariance


def _sums(values: Array, group: Index, n: int) -> Array:
    """(n, ...) sums over the last axis of `values` in each of n groups."""
    sums = np.zeros((n, *values.shape[:-1]))
    for entry in np.ndindex(values.shape[:-1]):
        sums[:, *entry] = np.bincount(group, values[entry], n)
    return sums


def misses(rays: Rays, rows: Index, points: Array) -> Array:
    """(N,) distances between rays and points (N, 3), relative to what noise and motion explain."""
    to = points - rays.o[rows]
    along = np.einsum("ni,ni->n", to, rays.d[rows])
    distance = np.sqrt(np.maximum(np.einsum("ni,ni->n", to, to) - along**2, 0))
    reach = SIGMAS * rays.sigma[rows] * along + MAX_SPEED_M_S * np.abs(rays.tau[rows])
    return np.where(along > 0, distance / np.maximum(reach, 1e-9), np.inf)
