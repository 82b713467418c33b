# SPDX-License-Identifier: BSD-3-Clause
"""Decides which bodies look alike, and which look like themselves in another pose.

The distances between its markers identify a constellation. An ambiguity by mirror reflection is harmless: the
reflected labeling turns the printed sides away from the cameras, or no rotation fits it.

Of a body with markers on several sides, cameras may see one side only. So each side with three markers or more must
differ from all other sides and from itself under rotation, as a flat robot must.
"""

import math
from bisect import bisect
from dataclasses import dataclass
from functools import lru_cache
from itertools import combinations, product

import numpy as np

from camera_node.foundation.arrays import Array, Index
from camera_node.geometry.body import Body
from camera_node.geometry.pose import rigid_motions

# Smallest difference of some distance between two labelings: several sigma of triangulation.
DISTINCT_M = 0.010
MIRRORED_M = 2 * DISTINCT_M  # by which the best rotation misses a labeling that only a reflection fits
MIN_MARKERS = 3  # of an identified constellation
SIDE_COS = math.cos(math.radians(30))  # between the normals of markers on one side


def sides(body: Body) -> list[Index]:
    """The sets of markers that face one way: for each marker those within 30 degrees of it, each set once."""
    if not body.normals:
        return [np.arange(len(body.markers))]
    normals = body.unit_normals
    return [np.flatnonzero(row) for row in np.unique(normals @ normals.T > SIDE_COS, axis=0)]


@dataclass(frozen=True, slots=True, eq=False)
class _Markers:
    """Some markers of a body: numbers (M,), positions (M, 3) and normals (M, 3), body frame; distances (M, M), and
    these sorted, one for each pair."""

    numbers: Index
    points: Array
    normals: Array
    distance: Array
    lengths: list[float]

    @classmethod
    def of(cls, body: Body, numbers: Index) -> "_Markers":
        points = body.points[numbers]
        distance = distances(points)
        lengths = sorted(distance[np.triu_indices(len(points), 1)].tolist())
        return cls(numbers, points, body.unit_normals[numbers], distance, lengths)

    def __len__(self) -> int:
        return len(self.numbers)


# Each body is compared with all others: at most 256 in an arena, and those of a request.
@lru_cache(maxsize=512)
def _distinctive(body: Body) -> list[_Markers]:
    """The parts of a constellation that acquisition may see alone: its sides with three markers or more, or all."""
    large = [side for side in sides(body) if len(side) >= MIN_MARKERS]
    return [_Markers.of(body, side) for side in large or [np.arange(len(body.markers))]]


def likeness(a: Body, b: Body) -> str | None:
    """How a part of one body looks like a part of another one; None if none does."""
    for parts in product(_distinctive(a), _distinctive(b)):
        if fault := _alike(*sorted(parts, key=len)):
            return fault
    return None


def symmetry(body: Body) -> str | None:
    """Why cameras can take a body for itself in another pose; None if they can't."""
    every = _Markers.of(body, np.arange(len(body.markers)))
    parts = _distinctive(body)
    for part in parts:
        if fault := _alike(part, part):
            where = "" if len(part) == len(every) else f" on the side of markers {_list(part)}"
            return f"symmetric under rotation{where}: {fault}"
    for a, b in combinations(parts, 2):
        if set(a.numbers) & set(b.numbers):
            continue  # they are seen together
        if fault := _alike(*sorted((a, b), key=len)):
            return f"ambiguous: the side of markers {_list(a)} equals that of {_list(b)} by rotation: {fault}"
    fault = None if len(parts[0]) == len(every) else _alike(every, every)
    return fault and f"symmetric under rotation: {fault}"


def _list(markers: _Markers) -> str:
    return ", ".join(map(str, markers.numbers.tolist()))


def _alike(small: _Markers, large: _Markers) -> str | None:
    """How the markers of `small` match some of `large`; for the same ones, in another order. None if they don't."""
    if not _may_match(small.lengths, large.lengths):
        return None
    D, E = small.distance, large.distance
    orders = _labelings(D, E)
    if small is large:
        orders = orders[(orders != np.arange(len(D))).any(1)]
    worst = np.abs(D - E[orders[:, :, None], orders[:, None]])  # (labelings, M, M)
    for k in range(len(orders)):
        if _may_be_seen_as(small, large, orders[k]):
            return _explain(small, large, orders[k], worst[k])
    return None


def _may_match(few: list[float], many: list[float]) -> bool:
    """Whether each of the sorted distances `few` may be another one of `many`: most pairs of robots fail this at once.

    A matching of equally many numbers within a bound exists only if they match in order.
    """
    if len(few) == len(many):
        return all(abs(a - b) < DISTINCT_M for a, b in zip(few, many, strict=True))
    return all(bisect(many, a - DISTINCT_M) < bisect(many, a + DISTINCT_M) for a in few)


def _may_be_seen_as(small: _Markers, large: _Markers, order: Index) -> bool:
    """Whether a rotation takes markers to others, and their prints to prints that the same cameras may see."""
    points = large.points[order]
    R, t = align(small.points, points)
    off = np.linalg.norm(small.points @ R.T + t - points, axis=1).max()
    faces = np.einsum("mi,mi->m", small.normals @ R.T, large.normals[order])
    return bool(off < MIRRORED_M and faces.min() > 0)


def _labelings(D: Array, E: Array) -> Index:
    """(L, M) the labelings of M markers as some of N under which no distance differs by `DISTINCT_M` or more.

    Marker by marker, so that a labeling ends at its first distance that differs.

    Args:
        D: (M, M) distances between the markers.
        E: (N, N) distances between those that they may be.
    """
    every = np.arange(len(E))
    orders = every[:, None]
    for m in range(1, len(D)):
        # (labelings, N) of the first m markers
        fits = (np.abs(E[orders] - D[m, :m, None]) < DISTINCT_M).all(1)
        fits &= (orders[:, :, None] != every).all(1)
        row, added = np.nonzero(fits)
        orders = np.column_stack([orders[row], added])
    return orders


def _explain(small: _Markers, large: _Markers, order: Index, worst: Array) -> str:
    D, E = small.distance, large.distance
    i, j = np.unravel_index(np.argmax(worst), worst.shape)
    a, b = sorted((order[i], order[j]))
    of, there = small.numbers, large.numbers
    return (
        f"the distance between markers {of[i]} and {of[j]} ({D[i, j] * 1e3:.1f} mm) and that between {there[a]} and "
        f"{there[b]} ({E[a, b] * 1e3:.1f} mm) differ most, by only {worst[i, j] * 1e3:.1f} mm; move a marker until "
        f"they differ by {DISTINCT_M * 1e3:.0f} mm or more"
    )


def distances(points: Array) -> Array:
    """(M, M) distances between points (M, 3)."""
    return np.linalg.norm(points[:, None] - points[None], axis=2)


def align(a: Array, b: Array) -> tuple[Array, Array]:
    """The rotation (3, 3) and translation (3,) that align points a (M, 3) with b (Kabsch 1976)."""
    T = rigid_motions(a, b)
    return T[:3, :3], T[:3, 3]
