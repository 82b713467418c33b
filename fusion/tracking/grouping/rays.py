# SPDX-License-Identifier: BSD-3-Clause
"""Viewing rays of detections, and the points at which several of them meet."""

from dataclasses import dataclass, fields, replace

import numpy as np

from camera_node.foundation.arrays import Array, Index
from fusion import _core
from fusion.model.observations import CameraArray, DetectionTable, Exposures
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


def misses(rays: Rays, rows: Index, points: Array) -> Array:
    """(N,) distances between rays and points (N, 3), relative to what noise and motion explain."""
    to = points - rays.o[rows]
    along = np.einsum("ni,ni->n", to, rays.d[rows])
    distance = np.sqrt(np.maximum(np.einsum("ni,ni->n", to, to) - along**2, 0))
    reach = SIGMAS * rays.sigma[rows] * along + MAX_SPEED_M_S * np.abs(rays.tau[rows])
    return np.where(along > 0, distance / np.maximum(reach, 1e-9), np.inf)


def misses_of_all(rays: Rays, rows: Index, points: Array) -> Array:
    """(N, K) `misses` of N rays and K points."""
    o, d = rays.o[rows], rays.d[rows]
    along = d @ points.T - np.einsum("ni,ni->n", o, d)[:, None]
    squared = np.einsum("ni,ni->n", o, o)[:, None] - 2 * o @ points.T + np.einsum("ki,ki->k", points, points)
    distance = np.sqrt(np.maximum(squared - along**2, 0))
    reach = rays.reach[rows][:, None] * along + np.abs(rays.moved[rows])[:, None]
    return np.where(along > 0, distance / np.maximum(reach, 1e-9), np.inf)
