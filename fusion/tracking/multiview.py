# SPDX-License-Identifier: BSD-3-Clause
"""Groups unassigned detections across views into markers, by epipolar geometry and apparent size.

1. Two rays of two frames are a candidate where they intersect in front of both cameras, at a range that both sizes
   allow.
2. The candidates of a ray lie along it. The true ones agree on the range, the false ones scatter: the densest range
   wins.
3. Rays whose points are within half a disc are one marker, since discs can't overlap. In every frame the closest ray
   remains.
4. An unassigned ray, or one close to another ray of its frame, joins the marker that it clearly intersects.

The result is one grouping over all cameras, in which each detection belongs to one marker at most. A ray that fits two
markers equally well joins neither. Free-running cameras see a moving marker at different positions, so the gates grow
with the time between frames.
"""

from dataclasses import dataclass
from itertools import pairwise
from math import isfinite, sqrt

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

from camera_node.arrays import Array, Index, Mask
from fusion import _core
from fusion.model.camera_array import CameraArray
from fusion.model.observations import DetectionTable
from fusion.tracking.gating import DIAMETER_TOLERANCE, MAX_SPEED_M_S

SIGMAS = 3.5
RAY_SLACK_PX = 0.5  # error of the calibration, and of an outline's centre as the centre of the disc
FAR_M = 50.0  # largest range of a ray without a size
CLEARLY = 0.5  # largest ratio of a ray's distances to the closest and the second closest marker
BLOCK = 64  # rays compared with all markers at a time: the distances stay in the cache
MIN_LIMIT = 10  # detections of a frame in a portion: those of two robots
JOIN_ROUNDS = 2  # of refinement before ambiguous rays are reassigned


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
class _Rays:
    """Viewing rays of N detections.

    Attributes:
        o, d: (N, 3) origins and unit directions, world frame.
        sigma: (N,) noise of the direction, rad.
        size: (N,) diameter per metre of range; NaN where unknown.
        tau: (N,) capture time minus the time of the frame set, seconds.
        frame, camera: (N,) indices.
    """

    o: Array
    d: Array
    sigma: Array
    size: Array
    tau: Array
    frame: Index
    camera: Index


def find_markers(
    cameras: CameraArray, detections: DetectionTable, rows: Index, diameters: Array
) -> list[Marker]:
    """Triangulate the markers that two or more cameras see.

    Args:
        cameras: cameras of the rig.
        detections: of a frame set.
        rows: its unassigned detections.
        diameters: marker diameters in use, metres; without known axes, geometry alone decides.
    """
    rows = rows[np.isfinite(detections.xy[0, rows])]
    rays = _rays_of(cameras, detections, rows)
    intersecting, points = _densest_points(cameras, detections, rays, diameters)
    if not len(points):
        return []
    group, centres = _cluster(rays, intersecting, points, np.min(diameters) / 2)
    for _ in range(JOIN_ROUNDS):
        group, centres = _refine(rays, group, centres)
    group, centres = _refine(rays, np.where(_ambiguous(rays), -1, group), centres)
    group = _join_unassigned(rays, group, centres)
    return _markers(rays, group, centres, rows)


@dataclass(frozen=True, slots=True)
class Portion:
    """Of frames with more than `limit` detections, those nearest to one point; another one in each turn.

    The point is on the ray of a detection of such a frame, at the range of a marker of `diameter_m`.
    """

    limit: int
    turn: int
    diameter_m: float


def limit_of(n_frames: int, max_pairs: int) -> int:
    """Detections of each of `n_frames` frames, such that those of different frames make at most `max_pairs` pairs."""
    return max(MIN_LIMIT, int(sqrt(2 * max_pairs / max(1, n_frames * (n_frames - 1)))))


def portion_of(
    cameras: CameraArray, detections: DetectionTable, rows: Index, portion: Portion
) -> tuple[Index, Index]:
    """The rows of this portion, all rows of frames below the limit; and the cameras of the frames above it."""
    limit, diameter_m = portion.limit, portion.diameter_m
    rows = rows[np.isfinite(detections.xy[0, rows])]
    count = np.bincount(detections.frame[rows], minlength=len(detections.exposures.camera))
    above = np.flatnonzero(count > limit)
    crowded = np.unique(detections.exposures.camera[above])
    if not len(above):
        return rows, crowded
    rays = _rays_of(cameras, detections, rows)
    seeds = np.flatnonzero(np.isin(rays.frame, above) & np.isfinite(rays.size))
    if not len(seeds):
        return rows[~np.isin(rays.frame, above)], crowded
    seed = seeds[np.random.default_rng(portion.turn).integers(len(seeds))]
    to = rays.o[seed] + rays.d[seed] * diameter_m / rays.size[seed] - rays.o
    off = -np.einsum("ni,ni->n", rays.d, to / np.linalg.norm(to, axis=1, keepdims=True))
    rank = np.empty(len(rows), np.intp)
    order = np.lexsort((off, rays.frame))
    rank[order] = np.arange(len(rows)) - np.concatenate([[0], np.cumsum(count)])[rays.frame[order]]
    return rows[rank < limit], crowded


def _rays_of(cameras: CameraArray, detections: DetectionTable, rows: Index) -> _Rays:
    seen = detections.select(rows)
    camera, d = seen.camera, cameras.rays(seen.camera, seen.xy)
    noise = np.sqrt((seen.cov[0, 0] + seen.cov[1, 1]) / 2 + RAY_SLACK_PX**2)
    focal = cameras.focal[camera]
    depth = 1 / np.sqrt(1 + seen.xy[0] ** 2 + seen.xy[1] ** 2)  # per metre of range
    size = seen.axes_px[0] * depth / focal
    return _Rays(cameras.centres[camera], d, noise * depth / focal, size, seen.tau, seen.frame, camera)


def _densest_points(
    cameras: CameraArray, detections: DetectionTable, rays: _Rays, diameters: Array
) -> tuple[Index, Array]:
    """The rays that intersect others, and the point (K, 3) on each at its densest range."""
    exposures = detections.exposures
    frames = _core.Viewpoints(exposures.camera, cameras.centres, MAX_SPEED_M_S * exposures.tau)
    reach, ranges = SIGMAS * rays.sigma, _possible_ranges(rays.size, diameters)
    range_m = _core.densest_ranges(frames, rays.frame, rays.d, reach, ranges)
    rows = np.flatnonzero(np.isfinite(range_m))
    return rows, rays.o[rows] + range_m[rows, None] * rays.d[rows]


def _possible_ranges(size: Array, diameters: Array) -> Array:
    """(N, K, 2) smallest and largest range of rays with this size (N,), for each of the diameters (K,)."""
    tolerance = np.array([-DIAMETER_TOLERANCE, DIAMETER_TOLERANCE])
    ranges = diameters[:, None] * (1 + tolerance) / size[:, None, None]
    ranges[np.isnan(size)] = 0, FAR_M
    return ranges


def _cluster(rays: _Rays, rows: Index, points: Array, radius: float) -> tuple[Index, Array]:
    """Single-linkage clusters of points closer than `radius`: the groups (N,) of the rays, and their centres."""
    pairs = KDTree(points).query_pairs(radius, output_type="ndarray")
    graph = coo_array((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(len(points),) * 2)
    number = connected_components(graph, directed=False)[1]
    group = np.full(len(rays.o), -1)
    group[rows] = number
    sums = np.column_stack([np.bincount(number, points[:, k]) for k in range(3)])
    return group, sums / np.bincount(number)[:, None]


def _refine(rays: _Rays, group: Index, centres: Array) -> tuple[Index, Array]:
    """Remove rays that miss their centre or are not the closest of their frame, and triangulate again.

    Groups with fewer than two cameras are dissolved; the others are renumbered from 0.
    """
    rows = np.flatnonzero(group >= 0)
    miss = _misses(rays, rows, centres[group[rows]])
    order = np.lexsort((miss, rays.frame[rows], group[rows]))
    order = order[miss[order] < 1]
    rank = group[rows[order]] * (int(rays.frame.max()) + 1) + rays.frame[rows[order]]
    closest = rows[order[np.concatenate([[True], np.diff(rank) > 0])]] if len(order) else order
    refined = np.full(len(group), -1)
    refined[closest] = group[closest]
    number = _renumber_groups(rays, refined, len(centres))
    refined[closest] = number[refined[closest]]
    return refined, _triangulate(rays, refined, centres[number >= 0])[0]


def _renumber_groups(rays: _Rays, group: Index, n: int) -> Index:
    """(n,) new numbers from 0 of the groups with two or more cameras, -1 for the others."""
    assigned = group >= 0
    seen = np.zeros((n, int(rays.camera.max(initial=0)) + 1), bool)
    seen[group[assigned], rays.camera[assigned]] = True
    valid = seen.sum(1) >= 2
    return np.where(valid, np.cumsum(valid) - 1, -1)


def _ambiguous(rays: _Rays) -> Mask:
    """(N,) rays so close to another of their frame that noise can exchange them."""
    reach = 2 * SIGMAS * rays.sigma
    near = KDTree(rays.d + rays.frame[:, None] * 10.0).query_pairs(float(reach.max()), output_type="ndarray")
    distance = np.linalg.norm(rays.d[near[:, 0]] - rays.d[near[:, 1]], axis=1)
    ambiguous = np.zeros(len(rays.d), bool)
    ambiguous[near[distance < reach[near[:, 0]]]] = True
    return ambiguous


def _triangulate(rays: _Rays, group: Index, near: Array) -> tuple[Array, Array]:
    """(K, 3) least-squares intersections of the rays of each group, and covariances (K, 3, 3).

    The weights follow from the noise at the range of `near` (K, 3), and from the motion between frames.
    """
    rows = np.flatnonzero(group >= 0)
    k, n, o, d = group[rows], len(near), rays.o[rows], rays.d[rows]
    range_m = np.einsum("ni,ni->n", near[k] - o, d)
    moved = MAX_SPEED_M_S / SIGMAS * np.abs(rays.tau[rows])
    weight = 1 / ((rays.sigma[rows] * range_m) ** 2 + moved**2)
    across = weight * (np.eye(3)[:, :, None] - d.T[:, None] * d.T)
    sums = np.zeros((n, 3, 4))
    for row, column in ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)):
        sums[:, row, column] = sums[:, column, row] = np.bincount(k, across[row, column], n)
    for row, side in enumerate(np.einsum("ijn,nj->in", across, o)):
        sums[:, row, 3] = np.bincount(k, side, n)
    covariance = np.asarray(np.linalg.inv(sums[:, :, :3] + 1e-9 * np.eye(3)), float)
    return np.einsum("nij,nj->ni", covariance, sums[:, :, 3]), covariance


def _misses(rays: _Rays, rows: Index, points: Array) -> Array:
    """(N,) distances between rays and points (N, 3), relative to what noise and motion explain."""
    to = points - rays.o[rows]
    along = np.einsum("ni,ni->n", to, rays.d[rows])
    distance = np.sqrt(np.maximum(np.einsum("ni,ni->n", to, to) - along**2, 0))
    reach = SIGMAS * rays.sigma[rows] * along + MAX_SPEED_M_S * np.abs(rays.tau[rows])
    return np.where(along > 0, distance / np.maximum(reach, 1e-9), np.inf)


def _two_closest(rays: _Rays, rows: Index, points: Array) -> tuple[Index, Array, Array]:
    """The closest point of each ray, and the distances (see `_misses`) to it and to the second closest one."""
    o, d = rays.o[rows], rays.d[rows]
    along = d @ points.T - np.einsum("ni,ni->n", o, d)[:, None]
    squared = np.einsum("ni,ni->n", o, o)[:, None] - 2 * o @ points.T + np.einsum("ki,ki->k", points, points)
    distance = np.sqrt(np.maximum(squared - along**2, 0))
    reach = (SIGMAS * rays.sigma[rows])[:, None] * along + (MAX_SPEED_M_S * np.abs(rays.tau[rows]))[:, None]
    miss = np.where(along > 0, distance / np.maximum(reach, 1e-9), np.inf)
    two = np.partition(np.column_stack([miss, np.full(len(rows), np.inf)]), 1, axis=1)
    return np.argmin(miss, 1), two[:, 0], two[:, 1]


def _join_unassigned(rays: _Rays, group: Index, centres: Array) -> Index:
    """Add each unassigned ray to the one marker that it clearly intersects, unless that has a ray in its frame."""
    free = np.flatnonzero(group < 0)
    if not len(free) or not len(centres):
        return group
    taken = np.zeros((len(centres), int(rays.frame.max()) + 1), bool)
    taken[group[group >= 0], rays.frame[group >= 0]] = True
    blocks = np.array_split(free, -(-len(free) // BLOCK))
    closest = [_two_closest(rays, block, centres) for block in blocks]
    best, first, second = (np.concatenate(column) for column in zip(*closest, strict=True))
    clear = (first < 1) & (first < CLEARLY * second) & ~taken[best, rays.frame[free]]
    group = group.copy()
    group[free[clear]] = best[clear]
    return group


def _markers(rays: _Rays, group: Index, centres: Array, rows: Index) -> list[Marker]:
    centres, covariance = _triangulate(rays, group, centres)
    assigned = np.flatnonzero(group >= 0)
    sizes = rays.size[assigned] * np.linalg.norm(centres[group[assigned]] - rays.o[assigned], axis=1)
    order = np.argsort(group[assigned], kind="stable")
    ends = np.cumsum(np.bincount(group[assigned], minlength=len(centres))).tolist()
    parts = [order[first:last] for first, last in pairwise([0, *ends])]
    return [
        Marker(
            centres[k], covariance[k], rows[assigned[part]], rays.camera[assigned[part]], _median(sizes[part])
        )
        for k, part in enumerate(parts)
    ]


def _median(sizes: Array) -> float:
    known = sorted(size for size in sizes.tolist() if isfinite(size))
    return known[len(known) // 2] if known else np.nan
