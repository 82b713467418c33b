# SPDX-License-Identifier: BSD-3-Clause
"""Groups unassigned detections across views into markers, by epipolar geometry and apparent size.

1. Two rays of two frames are a candidate where they intersect in front of both cameras, at a range that both sizes
   allow.
2. The candidates of a ray lie along it. The true ones agree on the range, the false ones scatter: the densest range
   wins.
3. Rays whose points are within half a disc are one marker, since discs can't overlap. In every frame the closest ray
   remains.
4. An unassigned ray, or one close to another ray of its frame, joins the marker that it clearly intersects.
5. Markers that three or more cameras see remain. Of the other rays, pairs are chosen by probability (`two_views`): for
   two rays the densest range is any of their intersections.

The result is one grouping over all cameras, in which each detection belongs to one marker at most. A ray that fits two
markers equally well joins neither. Free-running cameras see a moving marker at different positions, so the gates grow
with the time between frames.

`MarkerSearch` gives it the unassigned detections of a frame set: with the declared sizes, now and then with others. Of
crowded frames it searches the detections around one of them, another one in each turn.
"""

from dataclasses import dataclass
from itertools import pairwise
from math import isfinite, sqrt

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

from camera_node.foundation.arrays import Array, Index, Mask
from fusion import _core
from fusion.model.observations import Assignments, CameraArray, DetectionTable, Exposures, MarkerTable
from fusion.tracking.gating import ANY_DIAMETERS, DIAMETER_TOLERANCE
from fusion.tracking.ray_pairs import misfit_of, pair_rays
from fusion.tracking.rays import (
    Marker,
    Rays,
    diameters_of,
    frames_of,
    has_usual_size,
    join_moving,
    misses,
    misses_of_all,
    rays_of,
    triangulate,
)

CLEARLY = 0.5  # largest ratio of a ray's distances to the closest and the second closest marker
BLOCK = 64  # rays compared with all markers at a time: the distances stay in the cache
MOVING_ROUNDS = 2  # in which groups of a usual size claim their rays before the others
JOIN_ROUNDS = 2  # of refinement before ambiguous rays are reassigned


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
    rays = rays_of(cameras, detections, rows, diameters)
    radius = float(np.min(diameters)) / 2
    group, centres = _seen_by_three(rays.at_rest(), radius)
    if rays.tau.any():
        group, centres = _with_moving(rays, *_without_parts(rays, group, centres), radius)
    group, centres = _with_pairs(rays, group, centres)
    return _markers(rays, group, centres, rows)


def _seen_by_three(rays: Rays, radius: float) -> tuple[Index, Array]:
    """Groups (N,) of three or more cameras, -1 for the other rays, and their centres (K, 3)."""
    range_m = _core.densest_ranges(rays.viewpoints, rays.frame, rays.d, rays.reach, rays.moved, rays.ranges)
    rows = np.flatnonzero(np.isfinite(range_m))
    if not len(rows):
        return np.full(len(rays), -1), np.empty((0, 3))
    points = rays.o[rows] + range_m[rows, None] * rays.d[rows]
    group, centres = _cluster(rays, rows, points, radius)
    for _ in range(JOIN_ROUNDS):
        group, centres = _refine(rays, group, centres)
    group, centres = _refine(rays, np.where(_ambiguous(rays), -1, group), centres)
    group = _join_unassigned(rays, group, centres)
    number = _renumber_groups(rays, group, len(centres), 3)
    return np.append(number, -1)[group], centres[number >= 0]


def _without_parts(rays: Rays, group: Index, centres: Array) -> tuple[Index, Array]:
    """Without the groups that may be a part of a moving marker's rays: motion explains another ray or group, too."""
    if not len(centres):
        return group, centres
    free, has_ray = np.flatnonzero(group < 0), frames_of(rays, group, len(centres))
    explained = (misses_of_all(rays, free, centres) < 1) & ~has_ray[:, rays.frame[free]].T
    whole: Mask = np.logical_not(np.any(explained, axis=0))
    pairs = KDTree(centres).query_pairs(2 * float(np.abs(rays.moved).max()), output_type="ndarray")
    apart = ~(has_ray[pairs[:, 0]] & has_ray[pairs[:, 1]]).any(1)
    whole[pairs[apart]] = False
    return _select(group, centres, whole)


def _with_moving(rays: Rays, group: Index, centres: Array, radius: float) -> tuple[Index, Array]:
    """With the markers among the remaining rays that moved between frames: groups (N,) and centres (K, 3).

    Motion lets rays of several discs meet at a wrong range, where the discs have another size. So groups of an unusual
    size come after the others have joined all rays that they predict.
    """
    made, usual = (group, centres), np.ones(len(centres), bool)
    for _ in range(MOVING_ROUNDS):
        made = _with_remaining(rays, group, centres, radius)
        usual = has_usual_size(diameters_of(rays, *made))
        group, centres = join_moving(rays, *_select(*made, usual))
        if usual.all():
            return group, centres
    group, centres = _restore(group, centres, made, ~usual)
    return _with_remaining(rays, group, centres, radius)


def _with_remaining(rays: Rays, group: Index, centres: Array, radius: float) -> tuple[Index, Array]:
    """With the markers among the remaining rays that three cameras or more see: groups (N,) and centres (K, 3)."""
    left = np.flatnonzero(group < 0)
    of_moving, more = _seen_by_three(rays.select(left), radius)
    group = group.copy()
    group[left] = np.where(of_moving < 0, -1, len(centres) + of_moving)
    return group, np.concatenate([centres, more])


def _select(group: Index, centres: Array, chosen: Mask) -> tuple[Index, Array]:
    """Groups (N,) and centres of the chosen ones of K groups."""
    return np.append(np.where(chosen, np.cumsum(chosen) - 1, -1), -1)[group], centres[chosen]


def _restore(group: Index, centres: Array, before: tuple[Index, Array], chosen: Mask) -> tuple[Index, Array]:
    """With the chosen ones of the groups before, with their centres, if all their rays are free."""
    of_before, centres_before = before
    taken = np.bincount(of_before[(of_before >= 0) & (group >= 0)], minlength=len(centres_before)) > 0
    restored, more = _select(of_before, centres_before, chosen & ~taken)
    return np.where(restored >= 0, len(centres) + restored, group), np.concatenate([centres, more])


def _with_pairs(rays: Rays, group: Index, centres: Array) -> tuple[Index, Array]:
    """With the points that two of the remaining rays determine: groups (N,) and centres (K, 3)."""
    left = np.flatnonzero(group < 0)
    pairs, points = pair_rays(rays.select(left), misfit_of(rays, group, centres))
    group = group.copy()
    group[left[pairs]] = len(centres) + np.arange(pairs.shape[1])
    return group, np.concatenate([centres, points])


def _cluster(rays: Rays, rows: Index, points: Array, radius: float) -> tuple[Index, Array]:
    """Single-linkage clusters of points closer than `radius`: the groups (N,) of the rays, and their centres."""
    pairs = KDTree(points).query_pairs(radius, output_type="ndarray")
    graph = coo_array((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(len(points),) * 2)
    number = connected_components(graph, directed=False)[1]
    group = np.full(len(rays.o), -1)
    group[rows] = number
    sums = np.column_stack([np.bincount(number, points[:, k]) for k in range(3)])
    return group, sums / np.bincount(number)[:, None]


def _refine(rays: Rays, group: Index, centres: Array) -> tuple[Index, Array]:
    """Remove rays that miss their centre or are not the closest of their frame, and triangulate again.

    Groups with fewer than two cameras are dissolved; the others are renumbered from 0.
    """
    rows = np.flatnonzero(group >= 0)
    miss = misses(rays, rows, centres[group[rows]])
    order = np.lexsort((miss, rays.frame[rows], group[rows]))
    order = order[miss[order] < 1]
    rank = group[rows[order]] * (int(rays.frame.max()) + 1) + rays.frame[rows[order]]
    closest = rows[order[np.concatenate([[True], np.diff(rank) > 0])]] if len(order) else order
    refined = np.full(len(group), -1)
    refined[closest] = group[closest]
    number = _renumber_groups(rays, refined, len(centres), 2)
    refined[closest] = number[refined[closest]]
    return refined, triangulate(rays, refined, centres[number >= 0])[0]


def _renumber_groups(rays: Rays, group: Index, n: int, n_cameras: int) -> Index:
    """(n,) new numbers from 0 of the groups with so many cameras or more, -1 for the others."""
    assigned = group >= 0
    seen = np.zeros((n, int(rays.camera.max(initial=0)) + 1), bool)
    seen[group[assigned], rays.camera[assigned]] = True
    valid = seen.sum(1) >= n_cameras
    return np.where(valid, np.cumsum(valid) - 1, -1)


def _ambiguous(rays: Rays) -> Mask:
    """(N,) rays so close to another of their frame that noise can exchange them."""
    reach = 2 * rays.reach
    near = KDTree(rays.d + rays.frame[:, None] * 10.0).query_pairs(float(reach.max()), output_type="ndarray")
    distance = np.linalg.norm(rays.d[near[:, 0]] - rays.d[near[:, 1]], axis=1)
    ambiguous = np.zeros(len(rays.d), bool)
    ambiguous[near[distance < reach[near[:, 0]]]] = True
    return ambiguous


def _join_unassigned(rays: Rays, group: Index, centres: Array) -> Index:
    """Add each unassigned ray to the one marker that it clearly intersects, unless that has a ray in its frame."""
    free = np.flatnonzero(group < 0)
    if not len(free) or not len(centres):
        return group
    joined, has_ray = group.copy(), frames_of(rays, group, len(centres))
    for block in np.array_split(free, -(-len(free) // BLOCK)):
        miss = misses_of_all(rays, block, centres)
        best, of_block = np.argmin(miss, 1), np.arange(len(block))
        first = miss[of_block, best]
        second = np.partition(np.column_stack([miss, np.full(len(block), np.inf)]), 1, axis=1)[:, 1]
        clear = (first < 1) & (first < CLEARLY * second)
        clear &= ~has_ray[best, rays.frame[block]]
        joined[block[clear]] = best[clear]
    return joined


def _markers(rays: Rays, group: Index, centres: Array, rows: Index) -> list[Marker]:
    centres, covariance = triangulate(rays, group, centres)
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


MIN_LIMIT = 10  # detections of a frame in a portion: those of two robots


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
    rays = rays_of(cameras, detections, rows, np.array([diameter_m]))
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


def _one_of_each_camera(exposures: Exposures) -> Mask:
    """(F,) of the frames of each camera the one nearest to the time of the frame set."""
    order = np.lexsort((np.abs(exposures.tau), exposures.camera))
    nearest = np.zeros(len(order), bool)
    nearest[order[np.unique(exposures.camera[order], return_index=True)[1]]] = True
    return nearest


# Unassigned detections that no missing robot explains: the largest number of their pairs between different frames. Of
# more, those around one of them are searched, each in its turn: a robot among false detections is acquired later.
MAX_PAIRS = 80_000
# The same of detections that no declared size explains, above which other sizes are not searched for: a new robot is
# defined where little else is unassigned, and poses must not wait for it. That is 25 in each frame of 8 cameras.
MAX_OTHER_PAIRS = 20_000
# Frame sets from one search to the next, while none is found: for other sizes, and where no robot is missing.
OTHERS_EVERY = 8


class MarkerSearch:
    """Triangulates markers from unassigned detections.

    Args:
        cameras: cameras of the rig.

    Attributes:
        n_frame_sets: with unassigned detections, so far.
        is_due: whether unassigned detections stay, so that a search is worth its time also where no robot is missing.
    """

    def __init__(self, cameras: CameraArray) -> None:
        self._cameras = cameras
        self.n_frame_sets = 0
        self._has_others = False  # whether the last search for other sizes found markers
        self._has_found = True  # whether the last search found markers
        self.is_due = False

    def find(
        self, declared: MarkerTable, n_missing: int, detections: DetectionTable, assignments: Assignments
    ) -> tuple[list[Marker], Index]:
        """Triangulate markers from unassigned detections; and the cameras that have too many of these.

        With part of the detections, a robot can be taken for another one whose markers are not in this part. So all are
        searched that the markers of missing robots can explain. Of several frames of a camera only one is: others are
        of other times, and the work grows with the square of the frames, most of which arrive while the server is busy.

        Args:
            declared: the markers of all robots.
            n_missing: how many markers untracked robots have.
            detections: of a frame set.
            assignments: of the tracked robots.
        """
        used = _one_of_each_camera(detections.exposures)
        free = used[detections.frame]
        free[assignments.detection] = False
        diameters = np.unique(2 * declared.radius) if len(declared) else np.array(ANY_DIAMETERS)
        if not free.any():
            return [], free.nonzero()[0][:0]
        self.n_frame_sets += 1
        if not (n_missing or self._has_found or self.is_due) and self.n_frame_sets % OTHERS_EVERY:
            return [], free.nonzero()[0][:0]
        limit = n_missing + limit_of(int(used.sum()), MAX_PAIRS)
        portion = Portion(limit, self.n_frame_sets, float(np.median(diameters)))
        rows, crowded = portion_of(self._cameras, detections, np.flatnonzero(free), portion)
        markers = find_markers(self._cameras, detections, rows, diameters)
        if len(declared) and (self._has_others or self.n_frame_sets % OTHERS_EVERY == 0):
            others = self._find_other_sizes(detections, rows, markers, diameters)
            self._has_others = len(others) > 0
            markers += others
        self._has_found = bool(markers)
        return markers, crowded

    def _find_other_sizes(
        self, detections: DetectionTable, rows: Index, markers: list[Marker], diameters: Array
    ) -> list[Marker]:
        """Triangulate markers that no robot declares: a new robot may have another diameter.

        Args:
            detections: of a frame set.
            rows: that were searched.
            markers: that were found, of the declared `diameters`.
        """
        rest = np.setdiff1d(rows, np.concatenate([rows[:0], *(marker.detections for marker in markers)]))
        rest = rest[np.isfinite(detections.axes_px[0, rest])]
        count = np.bincount(detections.frame[rest])
        if not 0 < (count.sum() ** 2 - (count**2).sum()) // 2 <= MAX_OTHER_PAIRS:
            return []
        others = find_markers(self._cameras, detections, rest, np.array(ANY_DIAMETERS))
        size = np.array([marker.diameter_m for marker in others])
        is_other = np.all(np.abs(size[:, None] / diameters - 1) > DIAMETER_TOLERANCE, axis=1)
        return [others[k] for k in np.flatnonzero(is_other)]
