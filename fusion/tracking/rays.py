# SPDX-License-Identifier: BSD-3-Clause
"""Viewing rays of detections, the points at which several of them meet, and the motions that they determine.

Cameras that do not expose at once see a moving marker at several places. A group of three rays determines position and
velocity together with the prior of the velocity, and predicts the marker for the time of any other ray.
"""

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from camera_node.foundation.arrays import Array, Index, Mask
from camera_node.foundation.columns import Columns
from fusion import _core
from fusion.model.observations import CameraArray, DetectionTable, Exposures
from fusion.tracking.gating import DIAMETER_TOLERANCE, MAX_SPEED_M_S

SIGMAS = 3.5
RAY_SLACK_PX = 0.5  # error of the calibration, and of an outline's centre as the centre of the disc
FAR_M = 50.0  # largest range of a ray without a size


@dataclass(frozen=True, slots=True, eq=False)
class Rays(Columns):
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

    SHARED: ClassVar[frozenset[str]] = frozenset({"exposures", "centres"})

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
    noise = np.sqrt(seen.variance_px2 + RAY_SLACK_PX**2)
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


@dataclass(frozen=True, slots=True, eq=False)
class Marker:
    """A triangulated marker.

    Attributes:
        position, covariance: (3,) and (3, 3), world frame.
        detections, cameras: rows of its detections, and the index of the camera of each.
        diameter_m: median of its views; NaN where unknown.
    """

    position: Array
    covariance: Array
    detections: Index
    cameras: Index
    diameter_m: float


@dataclass(frozen=True, slots=True, eq=False)
class MarkerHistories:
    """What N markers did before: for how long they were tracked, seconds (N,), and how they moved (N,).

    A marker that moves with others belongs to one body with them. One that is alone moved since the last anchor, and
    none moved with it. The motions of anchored markers are compared.
    """

    age_s: Array
    anchored: Mask
    moves_with_others: Mask
    alone: Mask


GATE = 13.8  # chi-square with 2 degrees of freedom; rejects one true ray in 1000
EQUAL_SIZES = 0.06  # relative: measured diameters of equal prints differ by noise and blur


@dataclass(frozen=True, slots=True, eq=False)
class Motions:
    """K markers at the time of the frame set.

    Attributes:
        state: (K, 6) position and velocity, world, m and m/s.
        covariance: (K, 6, 6) of the state.
    """

    state: Array
    covariance: Array

    @property
    def positions(self) -> Array:
        """(K, 3)."""
        return self.state[:, :3]

    def misfit(self, rays: Rays, rows: Index, markers: Index) -> Array:
        """(N,) chi-square, with 2 degrees of freedom, of rays that are in no group and markers; inf behind a camera."""
        o, d, tau = rays.o[rows], rays.d[rows], rays.tau[rows]
        at_time = np.concatenate([np.tile(np.eye(3), (len(rows), 1, 1)), tau[:, None, None] * np.eye(3)], 2)
        to = np.einsum("nij,nj->ni", at_time, self.state[markers]) - o
        along = np.einsum("ni,ni->n", to, d)
        across = np.eye(3) - d[:, :, None] * d[:, None, :]
        off = np.einsum("nij,nj->ni", across, to)
        spread = across @ at_time
        noise = (rays.sigma[rows] * along) ** 2
        # Along the ray `off` is zero, so that the noise there has no effect.
        S = spread @ self.covariance[markers] @ spread.transpose(0, 2, 1) + noise[:, None, None] * np.eye(3)
        chi2 = np.einsum("ni,ni->n", off, np.linalg.solve(S, off[:, :, None])[:, :, 0])
        return np.where(along > 0, chi2, np.inf)


def fit_motions(rays: Rays, group: Index, near: Array) -> Motions:
    """Least squares for position and velocity of each of K groups of rays.

    The ray of time tau passes p + tau v. The prior of v has the standard deviation `MAX_SPEED_M_S` / `SIGMAS` in each
    direction. The weights follow from the noise at the range of `near` (K, 3). That is also the prior of p, with the
    range as standard deviation: cameras side by side do not determine a range.
    """
    rows = np.flatnonzero(group >= 0)
    k, o, d = group[rows], rays.o[rows], rays.d[rows]
    range_m, tau = np.einsum("ni,ni->n", near[k] - o, d), rays.tau[rows]
    weight = 1 / (rays.sigma[rows] * range_m) ** 2
    across = weight * (np.eye(3)[:, :, None] - d.T[:, None] * d.T)
    side = np.einsum("ijn,nj->in", across, o)
    information, right = np.zeros((len(near), 6, 6)), np.zeros((len(near), 6))
    prior = 1e-9 + _sums(range_m**-2, k, len(near))  # positive for groups without rays
    information[:, :3, :3] = _sums(across, k, len(near)) + prior[:, None, None] * np.eye(3)
    information[:, :3, 3:] = information[:, 3:, :3] = _sums(across * tau, k, len(near))
    information[:, 3:, 3:] = _sums(across * tau**2, k, len(near)) + (SIGMAS / MAX_SPEED_M_S) ** 2 * np.eye(3)
    right[:, :3] = _sums(side, k, len(near)) + prior[:, None] * near
    right[:, 3:] = _sums(side * tau, k, len(near))
    covariance = np.asarray(np.linalg.inv(information), float)
    return Motions(np.einsum("nij,nj->ni", covariance, right), covariance)


def _sums(values: Array, group: Index, n: int) -> Array:
    """(n, ...) sums over the last axis of `values` in each of n groups."""
    sums = np.zeros((n, *values.shape[:-1]))
    for entry in np.ndindex(values.shape[:-1]):
        sums[:, *entry] = np.bincount(group, values[entry], n)
    return sums


def triangulate(rays: Rays, group: Index, near: Array) -> tuple[Array, Array]:
    """(K, 3) positions of K groups at the time of the frame set, and covariances (K, 3, 3); see `fit_motions`."""
    motions = fit_motions(rays, group, near)
    return motions.positions, motions.covariance[:, :3, :3]


def frames_of(rays: Rays, group: Index, n: int) -> Mask:
    """(n, F) whether a group has a ray in a frame."""
    has_ray = np.zeros((n, int(rays.frame.max()) + 1), bool)
    has_ray[group[group >= 0], rays.frame[group >= 0]] = True
    return has_ray


def diameters_of(rays: Rays, group: Index, centres: Array) -> Array:
    """(K,) median diameter of each group, m; NaN where unknown."""
    rows = np.flatnonzero(group >= 0)
    size = rays.size[rows] * np.linalg.norm(centres[group[rows]] - rays.o[rows], axis=1)
    known = np.isfinite(size)
    k, size = group[rows][known], size[known]
    order, count = np.lexsort((size, k)), np.bincount(k, minlength=len(centres))
    middle = np.minimum(np.cumsum(count) - count + count // 2, max(len(size) - 1, 0))
    return np.where(count > 0, size[order][middle], np.nan) if len(size) else np.full(len(centres), np.nan)


def has_usual_size(diameters: Array) -> Mask:
    """(K,) markers whose diameter is not that of few among many of a similar one.

    Rays of several discs meet at a wrong range by chance, at which the discs seem too large or too small. Prints of one
    size seem equal, also where the declared diameter is wrong.
    """
    ratio = np.abs(np.log(diameters[:, None] / diameters))
    count = (ratio < EQUAL_SIZES).sum(1)
    most = np.max(np.where(ratio < 2 * DIAMETER_TOLERANCE, count, 0), axis=1, initial=0)
    return (2 * count >= most) | np.isnan(diameters)


def join_moving(rays: Rays, group: Index, centres: Array) -> tuple[Index, Array]:
    """Add each ray without a group to the one marker whose motion predicts it, if that predicts no other of its frame.

    Returns:
        groups (N,), and the centres (K, 3) at the time of the frame set.
    """
    free = np.flatnonzero(group < 0)
    if not len(centres) or not len(free):
        return group, centres
    motions, has_ray = fit_motions(rays, group, centres), frames_of(rays, group, len(centres))
    # Less strict than the gate of a group, because the velocity that is fitted is not that of this gate.
    near = misses_of_all(rays, free, motions.positions) < 2
    ray, marker = np.nonzero(near & ~has_ray[:, rays.frame[free]].T)
    size = rays.size[free[ray]] * np.linalg.norm(motions.positions[marker] - rays.o[free[ray]], axis=1)
    of_size = ~(np.abs(size / diameters_of(rays, group, centres)[marker] - 1) > DIAMETER_TOLERANCE / 2)
    ray, marker = ray[of_size], marker[of_size]
    fits = motions.misfit(rays, free[ray], marker) < GATE
    ray, marker = ray[fits], marker[fits]
    view = marker * has_ray.shape[1] + rays.frame[free[ray]]
    single = (np.bincount(ray, minlength=1)[ray] == 1) & (np.bincount(view, minlength=1)[view] == 1)
    joined = group.copy()
    joined[free[ray[single]]] = marker[single]
    return joined, fit_motions(rays, joined, centres).positions
