# SPDX-License-Identifier: BSD-3-Clause
"""Detections that no robot claims, matched across views into markers: epipolar geometry, and range by apparent size.

Free-running cameras see a moving marker at different places, so gates widen with the time between captures.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fusion.association import Sightings
from fusion.optics import Optics

Array = NDArray[np.float64]
Index = NDArray[np.intp]
SPEED_M_S = 2.0  # of the fastest marker that is looked for
SIGMAS = 3.0
SLACK_PX = 0.7  # what a calibration may be off, and an outline's centre from the disc's
DIAMETER_TOLERANCE = 0.2  # between the size that a view implies and a robot's marker
MIN_PARALLAX = np.sin(np.radians(3)) ** 2


@dataclass(frozen=True, slots=True, eq=False)
class Marker:
    """A marker that stands at `position` (3,), covariance (3, 3).

    `sightings` of `cameras` are of it; `diameter_m` is NaN where unknown.
    """

    position: Array
    covariance: Array
    sightings: Index
    cameras: Index
    diameter_m: float


@dataclass(frozen=True, slots=True, eq=False)
class _Rays:
    """Viewing rays of N sightings: o and d (N, 3), the angle noise (N,), metres of size per metre of range (N,)."""

    o: Array
    d: Array
    sigma: Array
    size: Array
    tau: Array
    frame: Index
    camera: Index


def group(optics: Optics, sightings: Sightings, rows: Index, diameters: Array) -> list[Marker]:
    """Markers that two or more cameras saw, as one grouping in which no detection is of two markers.

    Args:
        optics: the cameras.
        sightings: the detections of an instant.
        rows: those of them that are free.
        diameters: sizes of marker in use; where axes are unknown, geometry alone decides.
    """
    rays = _cast(optics, sightings, rows)
    points = _pair(rays, diameters)
    if not len(points):
        return []
    near, miss = _support(rays, points)
    markers, free = [], np.ones(len(rows), bool)
    for k in np.lexsort((np.nanmean(np.where(near, miss, np.nan), 1), -near.sum(1))):
        members = np.flatnonzero(near[k])
        if free[members].all():
            markers.append(_triangulate(rays, members, points[k], rows))
            free[members] = False
    return markers


def _cast(optics: Optics, sightings: Sightings, rows: Index) -> _Rays:
    seen = sightings.select(rows)
    d = np.full((len(rows), 3), np.nan)
    for k in np.unique(seen.camera):
        d[seen.camera == k] = optics.rays(int(k), seen.uv[seen.camera == k])
    noise = np.sqrt(np.trace(seen.cov, axis1=1, axis2=2) / 2 + SLACK_PX**2)
    focal = optics.focal[seen.camera]
    depth = np.einsum("ni,ni->n", optics.R_cam_world[seen.camera][:, 2], d)  # per metre of range
    size = seen.axes_px[:, 0] * depth / focal
    o = optics.centres[seen.camera]
    return _Rays(o, d, noise / focal, size, seen.tau, seen.frame, seen.camera)


def _pair(rays: _Rays, diameters: Array) -> Array:
    """(H, 3) points where two rays of different cameras meet and the sizes agree."""
    i, j = np.triu_indices(len(rays.o), 1)
    other = (rays.camera[i] != rays.camera[j]) & np.isfinite(rays.d[i] + rays.d[j]).all(1)
    i, j = i[other], j[other]
    w, b = rays.o[i] - rays.o[j], np.sum(rays.d[i] * rays.d[j], 1)
    wi, wj = np.sum(w * rays.d[i], 1), np.sum(w * rays.d[j], 1)
    parallax = np.maximum(1 - b * b, 1e-12)
    s, t = (b * wj - wi) / parallax, (wj - b * wi) / parallax
    a, c = rays.o[i] + s[:, None] * rays.d[i], rays.o[j] + t[:, None] * rays.d[j]
    reach = SIGMAS * np.hypot(rays.sigma[i] * s, rays.sigma[j] * t)
    reach += SPEED_M_S * np.abs(rays.tau[i] - rays.tau[j])
    meets = (np.linalg.norm(a - c, axis=1) < reach) & (parallax > MIN_PARALLAX) & (s > 0) & (t > 0)
    fits = _fits(rays.size[i] * s, diameters) & _fits(rays.size[j] * t, diameters)
    return ((a + c) / 2)[meets & fits]


def _fits(size: Array, diameters: Array) -> NDArray[np.bool_]:
    ratio = size[..., None] / diameters
    return np.isnan(size) | (np.abs(ratio - 1) < DIAMETER_TOLERANCE).any(-1)


def _support(rays: _Rays, points: Array) -> tuple[NDArray[np.bool_], Array]:
    """(H, N) the nearest sighting to each point in every frame, if near enough, and (H, N) how far it misses."""
    to = points[:, None] - rays.o
    along = np.einsum("hni,ni->hn", to, rays.d)
    off = np.linalg.norm(to - along[..., None] * rays.d, axis=2)
    reach = SIGMAS * rays.sigma * along + SPEED_M_S * np.abs(rays.tau - rays.tau.mean())
    with np.errstate(invalid="ignore", divide="ignore"):
        miss = np.where((off < reach) & (along > 0), off / reach, np.inf)
    near = np.zeros(miss.shape, bool)
    for frame in np.unique(rays.frame):
        columns = np.flatnonzero(rays.frame == frame)
        best = columns[np.argmin(miss[:, columns], 1)]
        near[np.arange(len(points)), best] = np.isfinite(miss[np.arange(len(points)), best])
    seen_twice = near.sum(1) >= 2
    return near & seen_twice[:, None], miss


def _triangulate(rays: _Rays, members: Index, near: Array, rows: Index) -> Marker:
    """The point of least squared distance to the rays, weighed by their noise and by motion between captures."""
    d = rays.d[members]
    range_m = np.linalg.norm(near - rays.o[members], axis=1)
    moved = SPEED_M_S / SIGMAS * np.abs(rays.tau[members] - rays.tau[members].mean())
    weight = 1 / ((rays.sigma[members] * range_m) ** 2 + moved**2)
    across = weight[:, None, None] * (np.eye(3) - d[:, :, None] * d[:, None])
    covariance = np.linalg.inv(across.sum(0) + 1e-9 * np.eye(3))
    position = covariance @ np.einsum("nij,nj->i", across, rays.o[members])
    sizes = rays.size[members] * range_m
    known = sizes[np.isfinite(sizes)]
    cameras = rays.camera[members]
    return Marker(
        position, covariance, rows[members], cameras, float(np.median(known)) if len(known) else np.nan
    )
