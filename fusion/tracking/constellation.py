# SPDX-License-Identifier: BSD-3-Clause
"""Identifies constellations among triangulated markers by the distances between them and by their visibility."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np

from camera_node.arrays import Array, Index, Mask
from fusion.model.robots import Robot, align, distances
from fusion.tracking.gating import DECISIVE_CHI2, DIAMETER_TOLERANCE
from fusion.tracking.multiview import Marker

SIGMAS = 3.0
SLACK_M = 0.004  # of a distance: markers are glued on by hand
MIN_MARKERS = 3  # of an identified constellation
MAX_JUDGED = (
    40  # fits compared by their detections in one frame set; more stay open until fewer robots are missing
)
# Limits of one robot: partial mappings, mappings of three or more markers, and maximal ones. Above them, as where late
# frames make distances uncertain by decimetres, the shape is not distinctive.
MAX_PARTIAL, MAX_MAPPINGS, MAX_FITS = 20_000, 5_000, 200
MAX_COMPARED = 1_000  # fits of all robots


@dataclass(frozen=True, slots=True, eq=False)
class Fit:
    """Robot `robot` at R, t, where its markers `numbers` are the triangulated markers `points`."""

    robot: int
    numbers: tuple[int, ...]
    points: tuple[int, ...]
    R: Array
    t: Array
    shape_chi2: float  # of the distances, or of the detections where these decide
    history_chi2: float  # of the position, relative to the last one

    @property
    def chi2(self) -> float:
        """The sum of both."""
        return self.shape_chi2 + self.history_chi2


@dataclass(frozen=True)
class Criteria:
    """What decides between fits besides distances.

    Attributes:
        faces: whether a marker with this normal shows its print to the cameras that saw it.
        history: chi-square of a robot's position, by where it was last.
        judge: chi-square of the detections of fits with estimated velocities; used where distances do not decide.
    """

    faces: Callable[[Marker, Array], bool]
    history: Callable[[int, Array], float]
    judge: Callable[[list[Fit]], Array]


def identify(robots: dict[int, Robot], markers: list[Marker], criteria: Criteria) -> list[Fit]:
    """Find constellations that explain more markers, or fit clearly better, than every rival.

    Args:
        robots: missing constellations, by row.
        markers: unassigned triangulated markers.
        criteria: see `Criteria`.
    """
    if len(markers) < MIN_MARKERS:
        return []
    scene = _Scene.of(markers)
    fits = [fit for k, robot in robots.items() for fit in _fits(k, robot, scene, criteria)]
    if len(fits) > MAX_COMPARED:
        return []
    fits = _judge_close(fits, criteria.judge)
    fits.sort(key=lambda fit: (-len(fit.points), fit.chi2))
    return [fits[k] for k in _accept(fits)]


def _accept(fits: list[Fit]) -> list[int]:
    """The fits, best first, that no accepted or equally good rival contradicts."""
    rivals = _rivals(fits)
    accepted: set[int] = set()
    for k, fit in enumerate(fits):
        equals = _equal_rivals(fits, rivals, k)
        open_ = [n for n in rivals[k] if not accepted.intersection(rivals[n])]
        if accepted.intersection(rivals[k]) or any(fits[n].chi2 < fit.chi2 + DECISIVE_CHI2 for n in equals):
            continue
        if all(n > k for n in open_):
            accepted.add(k)
    return sorted(accepted)


def _rivals(fits: list[Fit]) -> list[list[int]]:
    """For each fit, the others of the same robot or with a common marker."""
    robot = np.array([fit.robot for fit in fits], np.intp)
    uses = np.zeros((len(fits), 1 + max((max(fit.points) for fit in fits), default=0)), np.float32)
    for row, fit in zip(uses, fits, strict=True):
        row[list(fit.points)] = 1
    exclusive = (robot[:, None] == robot) | (uses @ uses.T > 0)
    np.fill_diagonal(exclusive, False)
    return [np.flatnonzero(row).tolist() for row in exclusive]


def _equal_rivals(fits: list[Fit], rivals: list[list[int]], k: int) -> list[int]:
    """The rivals of fit k with as many markers."""
    return [n for n in rivals[k] if len(fits[n].points) == len(fits[k].points)]


def _judge_close(fits: list[Fit], judge: Callable[[list[Fit]], Array]) -> list[Fit]:
    """The fits; where distances do not separate rivals, with the chi-square of their detections.

    Free-running cameras see a moving marker at different positions, which makes its distances uncertain. With an
    estimated velocity, detections separate constellations that differ by less.
    """
    rivals = _rivals(fits)
    close = [
        k
        for k, fit in enumerate(fits)
        if any(abs(fits[n].chi2 - fit.chi2) < DECISIVE_CHI2 for n in _equal_rivals(fits, rivals, k))
    ]
    if not 0 < len(close) <= MAX_JUDGED:
        return fits
    judged = list(fits)
    for k, chi2 in zip(close, judge([fits[k] for k in close]), strict=True):
        judged[k] = replace(fits[k], shape_chi2=float(chi2))
    return judged


@dataclass(frozen=True, slots=True, eq=False)
class _Scene:
    """N unassigned markers: positions X (N, 3), distances (N, N) and their tolerances (N, N), diameters (N,)."""

    markers: list[Marker]
    X: Array
    distances: Array
    tolerance: Array
    diameters: Array

    @classmethod
    def of(cls, markers: list[Marker]) -> "_Scene":
        X = np.array([marker.position for marker in markers])
        sigma = _distance_sigmas(X, np.array([marker.covariance for marker in markers]))
        diameters = np.array([marker.diameter_m for marker in markers])
        return cls(markers, X, distances(X), SLACK_M + SIGMAS * sigma, diameters)


def _fits(index: int, robot: Robot, scene: _Scene, criteria: Criteria) -> Iterator[Fit]:
    """All fits of the robot to three or more markers; none above `MAX_FITS`."""
    usable = np.flatnonzero(~(np.abs(scene.diameters / robot.diameter_m - 1) >= DIAMETER_TOLERANCE))
    mappings = _maximal(_consistent_mappings(robot, scene, usable))
    for mapping in mappings if len(mappings) <= MAX_FITS else ():
        numbers, points = list(mapping), list(mapping.values())
        chosen = [scene.markers[p] for p in points]
        R, t = align(robot.points[numbers], scene.X[points])
        if all(criteria.faces(marker, R[:, 2]) for marker in chosen):
            error = robot.points[numbers] @ R.T + t - scene.X[points]
            cov = np.array([m.covariance for m in chosen]) + SLACK_M**2 * np.eye(3)
            chi2 = float(np.einsum("ni,ni->", error, np.linalg.solve(cov, error[:, :, None])[:, :, 0]))
            yield Fit(index, tuple(numbers), tuple(points), R, t, chi2, criteria.history(index, t))


def _maximal(mappings: list[dict[int, int]]) -> list[dict[int, int]]:
    """The mappings that no other contains; at most `MAX_FITS` + 1."""
    maximal: list[dict[int, int]] = []
    for mapping in sorted(mappings, key=len, reverse=True):
        if len(maximal) <= MAX_FITS and not any(mapping.items() <= other.items() for other in maximal):
            maximal.append(mapping)
    return maximal


def _consistent_mappings(robot: Robot, scene: _Scene, usable: Index) -> list[dict[int, int]]:
    """Mappings of three or more of the robot's markers to points with all distances within tolerance.

    The search is breadth first. A row of `table` maps the robot's first markers to usable points, -1 for an unseen
    marker. Returns none if there are too many.
    """
    if len(usable) < MIN_MARKERS:
        return []
    D, n = distances(robot.points), len(robot.markers)
    E, tolerance = (A[np.ix_(usable, usable)] for A in (scene.distances, scene.tolerance))
    table = np.empty((1, 0), np.intp)
    for number in range(n):
        row, point = np.nonzero(_allowed(D[number], E, tolerance, table))
        skipped = table[(table >= 0).sum(1) + n - number > MIN_MARKERS]
        table = np.concatenate(
            [
                np.column_stack([table[row], point]),
                np.column_stack([skipped, np.full(len(skipped), -1)]),
            ]
        )
        if len(table) > MAX_PARTIAL:
            return []
    table = table[(table >= 0).sum(1) >= MIN_MARKERS]
    rows = table.tolist() if len(table) <= MAX_MAPPINGS else []
    return [{m: int(usable[p]) for m, p in enumerate(row) if p >= 0} for row in rows]


def _allowed(D: Array, E: Array, tolerance: Array, table: Index) -> Mask:
    """(rows, points) whether the next marker can be each point, given the mapped markers of each row.

    Args:
        D: distances of the next marker from the robot's markers.
        E, tolerance: (N, N) distances of the points.
        table: see `_consistent_mappings`.
    """
    allowed = np.ones((len(table), len(E)), bool)
    for m, column in enumerate(table.T):
        fits = np.abs(E[column] - D[m]) < tolerance[column]
        fits[np.arange(len(column)), column] = False
        allowed &= fits | (column < 0)[:, None]
    return allowed


def _distance_sigmas(X: Array, covariance: Array) -> Array:
    """(N, N) standard deviations of the distances between points."""
    between = X[:, None] - X[None]
    unit = between / np.maximum(np.linalg.norm(between, axis=2, keepdims=True), 1e-9)
    along = np.einsum("abi,aij,abj->ab", unit, covariance, unit, optimize=True)
    return np.sqrt(along + along.T)


def fits_size(marker: Marker, robot: Robot) -> bool:
    """Whether the marker has the robot's diameter; True where its diameter is unknown."""
    ratio = marker.diameter_m / robot.diameter_m
    return bool(np.isnan(ratio) or abs(ratio - 1) < DIAMETER_TOLERANCE)
