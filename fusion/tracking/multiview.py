# SPDX-License-Identifier: BSD-3-Clause
"""Detections that no robot claims, matched across views into markers: epipolar geometry, and range by apparent size.

1. Two rays of two frames are a candidate where they meet, before both cameras, at a range that suits both sizes.
2. A ray's candidates lie along it: the true ones agree about the range, the false ones scatter. The densest range wins.
3. Rays whose points are within half a disc are one marker: discs can't overlap. In every frame the nearest stays.
4. A ray that is left, or was too near another of its frame, joins the marker that it clearly meets.

So one grouping comes out over all cameras, in which no detection is of two markers. A ray that meets two markers alike
well joins neither. Free-running cameras see a moving marker at different places: gates widen with the time between.
"""

from dataclasses import dataclass
from itertools import pairwise
from math import isfinite

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

from camera_node.arrays import Array, Index, Mask
from fusion._core import densest_ranges
from fusion.model.camera_array import CameraArray
from fusion.model.observations import DetectionTable

SPEED_M_S = 2.0  # of the fastest marker that is looked for
SIGMAS = 3.5
SLACK_PX = 0.5  # what a calibration may be off, and an outline's centre from the disc's
DIAMETER_TOLERANCE = 0.2  # between the size that a view implies and a robot's marker
FAR_M = 50.0  # the range where no size tells one
CLEARLY = 0.5  # how much nearer a ray must be to one marker than to any other, of their distances


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


def group(optics: CameraArray, sightings: DetectionTable, rows: Index, diameters: Array) -> list[Marker]:
    """Markers that two or more cameras saw, as one grouping in which no detection is of two markers.

    Args:
        optics: the cameras.
        sightings: the detections of an instant.
        rows: those of them that are free.
        diameters: sizes of marker in use; where axes are unknown, geometry alone decides.
    """
    rows = rows[np.isfinite(sightings.xy[0, rows])]
    rays = _cast(optics, sightings, rows)
    met, points = _agree(optics, sightings, rays, diameters)
    if not len(points):
        return []
    owner, centres = _cluster(rays, met, points, np.min(diameters) / 2)
    for _ in range(2):
        owner, centres = _settle(rays, owner, centres)
    owner, centres = _settle(rays, np.where(_crowded(rays), -1, owner), centres)
    owner = _join(rays, owner, centres)
    return _markers(rays, owner, centres, rows)


def _cast(optics: CameraArray, sightings: DetectionTable, rows: Index) -> _Rays:
    seen = sightings.select(rows)
    camera, d = seen.camera, optics.rays(seen.camera, seen.xy)
    noise = np.sqrt((seen.cov[0, 0] + seen.cov[1, 1]) / 2 + SLACK_PX**2)
    focal = optics.focal[camera]
    depth = 1 / np.sqrt(1 + seen.xy[0] ** 2 + seen.xy[1] ** 2)  # per metre of range
    size = seen.axes_px[0] * depth / focal
    return _Rays(optics.centres[camera], d, noise * depth / focal, size, seen.tau, seen.frame, camera)


def _agree(
    optics: CameraArray, sightings: DetectionTable, rays: _Rays, diameters: Array
) -> tuple[Index, Array]:
    """The rays that meet others, and the point (K, 3) of each at the range on which most of these agree."""
    exposures = sightings.exposures
    frames = exposures.camera, optics.centres, SPEED_M_S * exposures.tau
    reach, ranges = SIGMAS * rays.sigma, _ranges(rays.size, diameters)
    range_m = densest_ranges(*frames, rays.frame, rays.d, reach, ranges)
    met = np.flatnonzero(np.isfinite(range_m))
    return met, rays.o[met] + range_m[met, None] * rays.d[met]


def _ranges(size: Array, diameters: Array) -> Array:
    """(N, K, 2) the least and the largest range that a ray's size (N,) suits, for each of the diameters (K,)."""
    tolerance = np.array([-DIAMETER_TOLERANCE, DIAMETER_TOLERANCE])
    ranges = diameters[:, None] * (1 + tolerance) / size[:, None, None]
    ranges[np.isnan(size)] = 0, FAR_M
    return ranges


def _cluster(rays: _Rays, met: Index, points: Array, radius: float) -> tuple[Index, Array]:
    """Owners (N,) and their centres: points that a chain of steps shorter than `radius` joins are of one marker."""
    pairs = KDTree(points).query_pairs(radius, output_type="ndarray")
    graph = coo_array((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(len(points),) * 2)
    number = connected_components(graph, directed=False)[1]
    owner = np.full(len(rays.o), -1)
    owner[met] = number
    sums = np.column_stack([np.bincount(number, points[:, k]) for k in range(3)])
    return owner, sums / np.bincount(number)[:, None]


def _settle(rays: _Rays, owner: Index, centres: Array) -> tuple[Index, Array]:
    """Owners without rays that miss their centre, or that are not the nearest of their frame; and better centres.

    Groups that fewer than two cameras see are dissolved; the rest are counted from 0.
    """
    held = np.flatnonzero(owner >= 0)
    miss = _miss(rays, held, centres[owner[held]])
    order = np.lexsort((miss, rays.frame[held], owner[held]))
    order = order[miss[order] < 1]
    rank = owner[held[order]] * (int(rays.frame.max()) + 1) + rays.frame[held[order]]
    first = held[order[np.concatenate([[True], np.diff(rank) > 0])]] if len(order) else order
    kept = np.full(len(owner), -1)
    kept[first] = owner[first]
    number = _number(rays, kept, len(centres))
    kept[first] = number[kept[first]]
    return kept, _triangulate(rays, kept, centres[number >= 0])[0]


def _number(rays: _Rays, owner: Index, n: int) -> Index:
    """(n,) numbers from 0 of the groups that two cameras see, -1 for the rest."""
    held = owner >= 0
    seen = np.zeros((n, int(rays.camera.max(initial=0)) + 1), bool)
    seen[owner[held], rays.camera[held]] = True
    kept = seen.sum(1) >= 2
    return np.where(kept, np.cumsum(kept) - 1, -1)


def _crowded(rays: _Rays) -> Mask:
    """(N,) rays so near another of their frame that noise may have exchanged them."""
    reach = 2 * SIGMAS * rays.sigma
    near = KDTree(rays.d + rays.frame[:, None] * 10.0).query_pairs(float(reach.max()), output_type="ndarray")
    apart = np.linalg.norm(rays.d[near[:, 0]] - rays.d[near[:, 1]], axis=1)
    crowded = np.zeros(len(rays.d), bool)
    crowded[near[apart < reach[near[:, 0]]]] = True
    return crowded


def _triangulate(rays: _Rays, owner: Index, near: Array) -> tuple[Array, Array]:
    """(K, 3) points of least squared distance to their rays, and covariances (K, 3, 3).

    Rays are weighed by noise, at their ranges to `near` (K, 3), and by motion.
    """
    held = np.flatnonzero(owner >= 0)
    k, n, o, d = owner[held], len(near), rays.o[held], rays.d[held]
    range_m = np.einsum("ni,ni->n", near[k] - o, d)
    moved = SPEED_M_S / SIGMAS * np.abs(rays.tau[held])
    weight = 1 / ((rays.sigma[held] * range_m) ** 2 + moved**2)
    across = weight * (np.eye(3)[:, :, None] - d.T[:, None] * d.T)
    sums = np.zeros((n, 3, 4))
    for row, column in ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)):
        sums[:, row, column] = sums[:, column, row] = np.bincount(k, across[row, column], n)
    for row, side in enumerate(np.einsum("ijn,nj->in", across, o)):
        sums[:, row, 3] = np.bincount(k, side, n)
    covariance = np.asarray(np.linalg.inv(sums[:, :, :3] + 1e-9 * np.eye(3)), float)
    return np.einsum("nij,nj->ni", covariance, sums[:, :, 3]), covariance


def _miss(rays: _Rays, rows: Index, points: Array) -> Array:
    """(N,) how far rays miss points (N, 3), each its own, as a share of what noise and motion explain."""
    to = points - rays.o[rows]
    along = np.einsum("ni,ni->n", to, rays.d[rows])
    off = np.sqrt(np.maximum(np.einsum("ni,ni->n", to, to) - along**2, 0))
    reach = SIGMAS * rays.sigma[rows] * along + SPEED_M_S * np.abs(rays.tau[rows])
    return np.where(along > 0, off / np.maximum(reach, 1e-9), np.inf)


def _join(rays: _Rays, owner: Index, centres: Array) -> Index:
    """Owners, with free rays given to the marker that they meet, if clearly one, that has no ray of their frame."""
    free = np.flatnonzero(owner < 0)
    if not len(free) or not len(centres):
        return owner
    taken = np.zeros((len(centres), int(rays.frame.max()) + 1), bool)
    taken[owner[owner >= 0], rays.frame[owner >= 0]] = True
    every = np.tile(np.arange(len(centres)), len(free))
    miss = _miss(rays, np.repeat(free, len(centres)), centres[every]).reshape(len(free), -1)
    two = np.partition(np.column_stack([miss, np.full(len(free), np.inf)]), 1, axis=1)[:, :2]
    best = np.argmin(miss, 1)
    clear = (two[:, 0] < 1) & (two[:, 0] < CLEARLY * two[:, 1]) & ~taken[best, rays.frame[free]]
    owner = owner.copy()
    owner[free[clear]] = best[clear]
    return owner


def _markers(rays: _Rays, owner: Index, centres: Array, rows: Index) -> list[Marker]:
    centres, covariance = _triangulate(rays, owner, centres)
    held = np.flatnonzero(owner >= 0)
    sizes = rays.size[held] * np.linalg.norm(centres[owner[held]] - rays.o[held], axis=1)
    order = np.argsort(owner[held], kind="stable")
    ends = np.cumsum(np.bincount(owner[held], minlength=len(centres))).tolist()
    parts = [order[first:last] for first, last in pairwise([0, *ends])]
    return [
        Marker(centres[k], covariance[k], rows[held[part]], rays.camera[held[part]], _median(sizes[part]))
        for k, part in enumerate(parts)
    ]


def _median(sizes: Array) -> float:
    known = sorted(size for size in sizes.tolist() if isfinite(size))
    return known[len(known) // 2] if known else np.nan
