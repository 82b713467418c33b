# SPDX-License-Identifier: BSD-3-Clause
"""Which markers are a robot: constellations by their distances, and by facing the cameras that see them."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np

from camera_node.arrays import Array, Index
from fusion.model.robots import Robot, align, distances
from fusion.tracking.multiview import DIAMETER_TOLERANCE, Marker

SIGMAS = 3.0
SLACK_M = 0.004  # of a distance: markers are glued on by hand
CLEARLY = 9.0  # by how much the runner-up's chi-square must be worse
MAX_JUDGED = 40  # fits in one instant: what is more stays open until fewer robots are looked for
# Ways of placing one robot's first markers, of three or more of them, and those of which none is part of another: where
# there are more, as where late frames leave distances uncertain by decimetres, its shape tells nothing.
MAX_BEGUN, MAX_WAYS, MAX_FITS = 20_000, 5_000, 200
MAX_COMPARED = 1_000  # fits of all robots: likewise


@dataclass(frozen=True, slots=True, eq=False)
class Fit:
    """Robot `robot` placed at R, t so that its markers `numbers` are the markers `points` of an instant."""

    robot: int
    numbers: tuple[int, ...]
    points: tuple[int, ...]
    R: Array
    t: Array
    shape2: float  # chi-square of the distances
    history2: float  # and of the robot's standing there

    @property
    def chi2(self) -> float:
        """Of both."""
        return self.shape2 + self.history2


def identify(
    robots: dict[int, Robot],
    markers: list[Marker],
    faces: Callable[[Marker, Array], bool],
    history: Callable[[int, Array], float],
    judge: Callable[[list[Fit]], Array],
) -> list[Fit]:
    """The constellations among `markers`, each with more markers, or fitting clearly better, than any rival.

    Args:
        robots: constellations to look for, by index.
        markers: what stands free.
        faces: whether a marker with this normal would show its print to the cameras that saw it.
        history: chi-square of a robot's standing there, by where it was last.
        judge: chi-square of each fit's detections, the robot's speed estimated; asked where distances don't decide.
    """
    if len(markers) < 3:
        return []
    scene = _Scene.of(markers)
    fits = [fit for k, robot in robots.items() for fit in _fits(k, robot, scene, faces, history)]
    if len(fits) > MAX_COMPARED:
        return []
    fits = _judged(fits, judge)
    fits.sort(key=lambda fit: (-len(fit.points), fit.chi2))
    rivals = _rivals(fits)
    accepted: set[int] = set()
    for k, fit in enumerate(fits):
        alike = _alike(fits, rivals, k)
        open_ = [n for n in rivals[k] if not accepted.intersection(rivals[n])]
        if accepted.intersection(rivals[k]) or any(fits[n].chi2 < fit.chi2 + CLEARLY for n in alike):
            continue
        if all(n > k for n in open_):
            accepted.add(k)
    return [fits[k] for k in sorted(accepted)]


def _rivals(fits: list[Fit]) -> list[list[int]]:
    """Of each, the others with which it can't be true: of the same robot, or with a marker of its own."""
    robot = np.array([fit.robot for fit in fits], np.intp)
    has = np.zeros((len(fits), 1 + max((max(fit.points) for fit in fits), default=0)), np.float32)
    for row, fit in zip(has, fits, strict=True):
        row[list(fit.points)] = 1
    either = (robot[:, None] == robot) | (has @ has.T > 0)
    np.fill_diagonal(either, False)
    return [np.flatnonzero(row).tolist() for row in either]


def _alike(fits: list[Fit], rivals: list[list[int]], k: int) -> list[int]:
    """Those of its rivals that explain as many markers."""
    return [n for n in rivals[k] if len(fits[n].points) == len(fits[k].points)]


def _judged(fits: list[Fit], judge: Callable[[list[Fit]], Array]) -> list[Fit]:
    """The same; those that distances do not tell from a rival by what their detections say.

    Free-running cameras see a moving marker at different places, and its distances to others are as uncertain. Where
    a speed is estimated with the pose, detections tell shapes apart that differ by less.
    """
    rivals = _rivals(fits)
    open_ = [
        k
        for k, fit in enumerate(fits)
        if any(abs(fits[n].chi2 - fit.chi2) < CLEARLY for n in _alike(fits, rivals, k))
    ]
    if not 0 < len(open_) <= MAX_JUDGED:
        return fits
    judged = list(fits)
    for k, shape2 in zip(open_, judge([fits[k] for k in open_]), strict=True):
        judged[k] = replace(fits[k], shape2=float(shape2))
    return judged


@dataclass(frozen=True, slots=True, eq=False)
class _Scene:
    """The markers that stand free: positions X (N, 3), their distances (N, N) and how far off those may be."""

    markers: list[Marker]
    X: Array
    distances: Array
    tolerance: Array
    diameters: Array

    @classmethod
    def of(cls, markers: list[Marker]) -> "_Scene":
        X = np.array([marker.position for marker in markers])
        spread = _spread(X, np.array([marker.covariance for marker in markers]))
        sizes = np.array([marker.diameter_m for marker in markers])
        return cls(markers, X, distances(X), SLACK_M + SIGMAS * spread, sizes)


def _fits(
    index: int,
    robot: Robot,
    scene: _Scene,
    faces: Callable[[Marker, Array], bool],
    history: Callable[[int, Array], float],
) -> Iterator[Fit]:
    """All ways to see the robot in three or more of the markers; none where there are too many."""
    usable = np.flatnonzero(~(np.abs(scene.diameters / robot.diameter_m - 1) >= DIAMETER_TOLERANCE))
    longest = _longest(_search(robot, scene, usable))
    for mapping in longest if len(longest) <= MAX_FITS else ():
        numbers, points = list(mapping), list(mapping.values())
        chosen = [scene.markers[p] for p in points]
        R, t = align(robot.points[numbers], scene.X[points])
        if all(faces(marker, R[:, 2]) for marker in chosen):
            error = robot.points[numbers] @ R.T + t - scene.X[points]
            cov = np.array([m.covariance for m in chosen]) + SLACK_M**2 * np.eye(3)
            chi2 = float(np.einsum("ni,ni->", error, np.linalg.solve(cov, error[:, :, None])[:, :, 0]))
            yield Fit(index, tuple(numbers), tuple(points), R, t, chi2, history(index, t))


def _longest(mappings: list[dict[int, int]]) -> list[dict[int, int]]:
    """Those that are no part of another; no more than one beyond `MAX_FITS`."""
    longest: list[dict[int, int]] = []
    for mapping in sorted(mappings, key=len, reverse=True):
        if len(longest) <= MAX_FITS and not any(mapping.items() <= other.items() for other in longest):
            longest.append(mapping)
    return longest


def _search(robot: Robot, scene: _Scene, usable: Index) -> list[dict[int, int]]:
    """Mappings of three or more of the robot's markers to points, all distances within the tolerance.

    Breadth first: a row of `table` is one way to place the robot's first markers, -1 for one that is not seen. None
    where there are too many.
    """
    if len(usable) < 3:
        return []
    D, n = distances(robot.points), len(robot.markers)
    E, tolerance = (A[np.ix_(usable, usable)] for A in (scene.distances, scene.tolerance))
    table = np.empty((1, 0), np.intp)
    for number in range(n):
        allowed = np.ones((len(table), len(usable)), bool)
        for m, column in enumerate(table.T):
            fits = np.abs(E[column] - D[number, m]) < tolerance[column]
            fits[np.arange(len(column)), column] = False
            allowed &= fits | (column < 0)[:, None]
        row, point = np.nonzero(allowed)
        skipped = table[(table >= 0).sum(1) + n - number > 3]
        table = np.concatenate(
            [
                np.column_stack([table[row], point]),
                np.column_stack([skipped, np.full(len(skipped), -1)]),
            ]
        )
        if len(table) > MAX_BEGUN:
            return []
    table = table[(table >= 0).sum(1) >= 3]
    rows = table.tolist() if len(table) <= MAX_WAYS else []
    return [{m: int(usable[p]) for m, p in enumerate(row) if p >= 0} for row in rows]


def _spread(X: Array, covariance: Array) -> Array:
    """(N, N) standard deviations of the distances between points."""
    between = X[:, None] - X[None]
    unit = between / np.maximum(np.linalg.norm(between, axis=2, keepdims=True), 1e-9)
    along = np.einsum("abi,aij,abj->ab", unit, covariance, unit, optimize=True)
    return np.sqrt(along + along.T)


def fits_size(marker: Marker, robot: Robot) -> bool:
    """Whether the marker is of the robot's size, as far as it is known."""
    ratio = marker.diameter_m / robot.diameter_m
    return bool(np.isnan(ratio) or abs(ratio - 1) < DIAMETER_TOLERANCE)
