# SPDX-License-Identifier: BSD-3-Clause
"""Which markers are a robot: constellations by their distances, and by facing the cameras that see them."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fusion.grouping import DIAMETER_TOLERANCE, Marker
from fusion.robots import Robot, align, distances

Array = NDArray[np.float64]
SIGMAS = 3.0
SLACK_M = 0.004  # of a distance: markers are glued on by hand
CLEARLY = 9.0  # by how much the runner-up's chi-square must be worse


@dataclass(frozen=True, slots=True, eq=False)
class Fit:
    """Robot `robot` placed at R, t so that its markers `numbers` are the markers `points` of an instant."""

    robot: int
    numbers: tuple[int, ...]
    points: tuple[int, ...]
    R: Array
    t: Array
    chi2: float

    def rivals(self, other: "Fit") -> bool:
        """Whether both can't be true."""
        return self.robot == other.robot or bool(set(self.points) & set(other.points))


def identify(
    robots: dict[int, Robot], markers: list[Marker], faces: Callable[[Marker, Array], bool]
) -> list[Fit]:
    """The constellations among `markers`, each with more markers, or fitting clearly better, than any rival.

    Args:
        robots: constellations to look for, by index.
        markers: what stands free.
        faces: whether a marker with this normal would show its print to the cameras that saw it.
    """
    fits = [fit for k, robot in robots.items() for fit in _fits(k, robot, markers, faces)]
    fits.sort(key=lambda fit: (-len(fit.points), fit.chi2))
    accepted: list[Fit] = []
    for k, fit in enumerate(fits):
        if any(fit.rivals(better) for better in accepted):
            continue
        rest = (
            other for other in fits[k + 1 :] if fit.rivals(other) and len(other.points) == len(fit.points)
        )
        if any(other.chi2 < fit.chi2 + CLEARLY for other in rest):
            continue
        if any(
            fit.rivals(other) for other in fits[:k] if other not in accepted and not _beaten(other, accepted)
        ):
            continue
        accepted.append(fit)
    return accepted


def _beaten(fit: Fit, accepted: list[Fit]) -> bool:
    return any(fit.rivals(better) for better in accepted)


def _fits(
    index: int, robot: Robot, markers: list[Marker], faces: Callable[[Marker, Array], bool]
) -> Iterator[Fit]:
    """All ways to see the robot in three or more of the markers, subsets of a longer one left out."""
    usable = [k for k, marker in enumerate(markers) if fits_size(marker, robot)]
    if len(usable) < 3:
        return
    X = np.array([markers[k].position for k in usable])
    D, E = distances(robot.points), distances(X)
    tolerance = SLACK_M + SIGMAS * _spread(X, np.array([markers[k].covariance for k in usable]))
    longest: list[dict[int, int]] = []
    for mapping in sorted(_search(D, E, tolerance), key=len, reverse=True):
        if any(mapping.items() <= other.items() for other in longest):
            continue
        longest.append(mapping)
        numbers, rows = tuple(mapping), list(mapping.values())
        chosen = [markers[usable[row]] for row in rows]
        R, t = align(robot.points[list(numbers)], X[rows])
        if all(faces(marker, R[:, 2]) for marker in chosen):
            error = robot.points[list(numbers)] @ R.T + t - X[rows]
            chi2 = sum(e @ np.linalg.solve(m.covariance, e) for e, m in zip(error, chosen, strict=True))
            yield Fit(index, numbers, tuple(usable[row] for row in rows), R, t, float(chi2))


def _search(D: Array, E: Array, tolerance: Array) -> Iterator[dict[int, int]]:
    """Mappings of three or more of the robot's markers to points, all distances within the tolerance."""

    def extend(number: int, mapping: dict[int, int]) -> Iterator[dict[int, int]]:
        if number == len(D):
            if len(mapping) >= 3:
                yield mapping
            return
        for row in set(range(len(E))) - set(mapping.values()):
            if all(abs(D[number, n] - E[row, r]) < tolerance[row, r] for n, r in mapping.items()):
                yield from extend(number + 1, {**mapping, number: row})
        if len(mapping) + len(D) - number > 3:
            yield from extend(number + 1, mapping)

    return extend(0, {})


def _spread(X: Array, covariance: Array) -> Array:
    """(N, N) standard deviations of the distances between points."""
    between = X[:, None] - X[None]
    unit = between / np.maximum(np.linalg.norm(between, axis=2, keepdims=True), 1e-9)
    along = np.einsum("abi,aij,abj->ab", unit, covariance, unit)
    return np.sqrt(along + along.T)


def fits_size(marker: Marker, robot: Robot) -> bool:
    """Whether the marker is of the robot's size, as far as it is known."""
    ratio = marker.diameter_m / robot.diameter_m
    return bool(np.isnan(ratio) or abs(ratio - 1) < DIAMETER_TOLERANCE)
