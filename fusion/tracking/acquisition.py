# SPDX-License-Identifier: BSD-3-Clause
"""Acquires untracked robots from unassigned detections.

Constellations are identified by the distances between their markers and by their last positions; then robots with a
single marker, by size and reach. A marker that fits two robots equally well stays unlabeled.
"""

from dataclasses import dataclass, replace

import numpy as np

from camera_node.arrays import Array, Index
from fusion.model.camera_array import CameraArray
from fusion.model.observations import Assignments, DetectionTable, MatchedObservations
from fusion.model.states import POSITION, States
from fusion.tracking.constellation import Criteria, Fit, fits_size, identify
from fusion.tracking.estimator import Estimator
from fusion.tracking.gating import (
    MAX_CHI2,
    POSITION_GATE,
    START_S,
    START_SIGMAS,
    START_SIGMAS_SINGLE,
    mean_by_body,
    misfit,
)
from fusion.tracking.multiview import Marker, find_markers
from fusion.tracking.normals import start_rotation
from fusion.tracking.track_table import TrackTable

SMALL = 1e-3  # rad and m; a larger correction of a start is followed by another linearization
START_M = 0.1  # standard deviation of `start_m`
FAR_CHI2 = 50.0  # bound of a constellation's history: it may have been carried elsewhere
MAX_DETECTIONS = 600  # unassigned, of one frame; more come from a texture or a fault, and are not searched
MAX_BODIES = 12  # constellations searched for in one frame set; the others follow in the next ones


@dataclass(frozen=True, slots=True, eq=False)
class Acquired:
    """The result of an acquisition.

    Attributes:
        rows, states: acquired robots and where they are.
        displaced: single-marker robots whose detections belong to an acquired constellation.
        assignments: of all robots, including the acquired ones.
        markers: triangulated markers that stay unlabeled.
    """

    rows: Index
    states: States
    displaced: Index
    assignments: Assignments
    markers: list[Marker]


@dataclass(frozen=True, slots=True, eq=False)
class _Start:
    """A robot at R, p with the assignments that support it."""

    robot: int
    R: Array
    p: Array
    assignments: Assignments


@dataclass(frozen=True, slots=True, eq=False)
class _Refined:
    """N starts after an update.

    Attributes:
        states: of the starts.
        body: (K,) the start of each observation.
        misfit: (K,) squared residuals in standard deviations.
        assignments: of the observations.
    """

    states: States
    body: Index
    misfit: Array
    assignments: Assignments


@dataclass(frozen=True, slots=True, eq=False)
class _Accepted:
    """The starts that their observations confirm."""

    rows: Index
    states: States
    assignments: Assignments


class Acquisition:
    """Acquires robots of a track table.

    Args:
        cameras: cameras of the rig.
        estimator: of all robots.
        leads: whether this shard reports the unlabeled markers, and so needs them in every frame set.
    """

    def __init__(self, cameras: CameraArray, estimator: Estimator, leads: bool) -> None:
        self._cameras, self._estimator, self._leads = cameras, estimator, leads
        self._turn = 0  # rotates through more than MAX_BODIES missing constellations

    def acquire(
        self, table: TrackTable, missing: Index, detections: DetectionTable, assignments: Assignments
    ) -> Acquired:
        """Acquire robots.

        Args:
            table: robots, states and status.
            missing: rows of the untracked robots.
            detections: of a frame set.
            assignments: of the tracked robots.
        """
        none = _Accepted(missing[:0], table.states.select(missing[:0]), Assignments.none())
        if not len(missing) and not self._leads:
            return Acquired(none.rows, none.states, missing, assignments, [])
        bodies, singles = missing[~table.single[missing]], missing[table.single[missing]]
        found, displaced = none, missing[:0]
        if len(bodies):
            found, displaced, assignments = self._acquire_bodies(table, bodies, detections, assignments)
        markers = self._find_markers(table, detections, assignments)
        if len(singles):
            more = self._acquire_singles(table, singles, markers, detections)
            assignments = assignments.joined(more.assignments)
            taken = set(more.assignments.detection.tolist())
            markers = [m for m in markers if not taken.intersection(m.detections.tolist())]
            found = replace(
                found,
                rows=np.concatenate([found.rows, more.rows]),
                states=found.states.joined(more.states),
            )
        return Acquired(found.rows, found.states, displaced, assignments, markers)

    def _acquire_bodies(
        self, table: TrackTable, missing: Index, detections: DetectionTable, assignments: Assignments
    ) -> tuple[_Accepted, Index, Assignments]:
        """The constellations found, the single-marker robots that they displace, and all assignments.

        A marker of a constellation may be assigned to a single-marker robot: its assignments are searched too.
        """
        is_single = table.single[table.markers.robot[assignments.marker]]
        of_singles, assignments = assignments.select(is_single), assignments.select(~is_single)
        markers = self._find_markers(table, detections, assignments)
        turn = np.roll(missing, -self._turn)[:MAX_BODIES]
        self._turn = (self._turn + MAX_BODIES) % len(missing) if len(missing) > MAX_BODIES else 0
        fits = identify(
            {int(k): table.robots[k] for k in turn}, markers, self._criteria(table, markers, detections)
        )
        starts = [_start_of(fit, markers, table) for fit in fits if table.owned[fit.robot]]
        found = self._confirm(table, starts, detections, START_SIGMAS)
        assignments = assignments.joined(found.assignments)
        taken = np.isin(of_singles.detection, assignments.detection)
        displaced = np.unique(of_singles.marker[taken])
        remaining = of_singles.select(~np.isin(of_singles.marker, displaced))
        return found, table.markers.robot[displaced], assignments.joined(remaining)

    def _criteria(self, table: TrackTable, markers: list[Marker], detections: DetectionTable) -> Criteria:
        def faces(marker: Marker, normal: Array) -> bool:
            to = self._cameras.centres[marker.cameras] - marker.position
            return bool((to @ normal > 0).all())

        def history(k: int, p: Array) -> float:
            return min(_history_chi2(table, k, p, np.zeros((3, 3))), FAR_CHI2)

        def judge(fits: list[Fit]) -> Array:
            starts = [_start_of(fit, markers, table) for fit in fits]
            refined = self._refine(table, starts, detections, START_SIGMAS)
            return np.bincount(refined.body, refined.misfit, len(starts)).astype(float)

        return Criteria(faces, history, judge)

    def _acquire_singles(
        self, table: TrackTable, missing: Index, markers: list[Marker], detections: DetectionTable
    ) -> _Accepted:
        starts = []
        for robot, marker in _pair_singles(table, missing.tolist(), markers):
            R, _ = start_rotation(self._cameras, detections, marker, table.robots[robot].diameter_m / 2)
            assignments = _assignments_of(table, robot, (0,), [marker])
            starts.append(_Start(robot, R, marker.position, assignments))
        return self._confirm(table, starts, detections, START_SIGMAS_SINGLE)

    def _find_markers(
        self, table: TrackTable, detections: DetectionTable, assignments: Assignments
    ) -> list[Marker]:
        """Triangulate markers from unassigned detections."""
        free = np.ones(len(detections), bool)
        free[assignments.detection] = False
        count = np.bincount(detections.frame[free], minlength=len(detections.exposures.camera))
        free &= (count <= MAX_DETECTIONS)[detections.frame]
        diameters = np.unique(2 * table.markers.radius)
        if not free.any() or not len(diameters):
            return []
        return find_markers(self._cameras, detections, np.flatnonzero(free), diameters)

    def _confirm(
        self, table: TrackTable, starts: list[_Start], detections: DetectionTable, sigmas: tuple
    ) -> _Accepted:
        """Refine starts by their observations; returns those that fit."""
        if not starts:
            none = np.empty(0, np.intp)
            return _Accepted(none, table.states.select(none), Assignments.none())
        refined = self._refine(table, starts, detections, sigmas)
        good = mean_by_body(refined.misfit, refined.body, len(starts)) < MAX_CHI2
        rows = np.array([start.robot for start in starts])[good]
        return _Accepted(rows, refined.states.select(good), refined.assignments.select(good[refined.body]))

    def _refine(
        self, table: TrackTable, starts: list[_Start], detections: DetectionTable, sigmas: tuple
    ) -> _Refined:
        """Update each start independently with its observations, from these standard deviations."""
        at = States.at_rest(np.array([s.R for s in starts]), np.array([s.p for s in starts]), sigmas)
        assignments = Assignments.none().joined(*(start.assignments for start in starts))
        observations = MatchedObservations.of(assignments, detections, table.markers)
        body = np.repeat(np.arange(len(starts)), [len(start.assignments) for start in starts])
        observations = replace(observations, discs=replace(observations.discs, body=body))
        estimator = self._estimator.select(np.array([start.robot for start in starts]))
        prediction = estimator.predict(at, np.full(len(starts), START_S))
        states, residuals = estimator.update(prediction, observations, SMALL)
        d2 = misfit(observations, residuals)
        return _Refined(states, body, d2, assignments.with_residuals(residuals))


def _start_of(fit: Fit, markers: list[Marker], table: TrackTable) -> _Start:
    assignments = _assignments_of(table, fit.robot, fit.numbers, [markers[p] for p in fit.points])
    return _Start(fit.robot, fit.R, fit.t, assignments)


def _assignments_of(
    table: TrackTable, robot: int, numbers: tuple[int, ...], markers: list[Marker]
) -> Assignments:
    """The detections of triangulated markers, assigned to the robot's markers `numbers`."""
    rows = table.markers.first[robot] + np.array(numbers, np.intp)
    counts = [len(marker.detections) for marker in markers]
    return Assignments.of(np.concatenate([m.detections for m in markers]), np.repeat(rows, counts))


def _pair_singles(table: TrackTable, missing: list[int], markers: list[Marker]) -> list[tuple[int, Marker]]:
    """Pairs of an owned single-marker robot and a marker, each the only one within reach of the other."""
    within = np.array([[_reaches(table, k, marker) for marker in markers] for k in missing], bool)
    within = within.reshape(len(missing), len(markers))
    return [
        (k, markers[int(np.argmax(row))])
        for k, row in zip(missing, within, strict=True)
        if table.owned[k] and row.sum() == 1 and within[:, np.argmax(row)].sum() == 1
    ]


def _reaches(table: TrackTable, k: int, marker: Marker) -> bool:
    """Whether the size and the history of single-marker robot k allow this marker."""
    if not fits_size(marker, table.robots[k]):
        return False
    return _history_chi2(table, k, marker.position, marker.covariance) < POSITION_GATE


def _history_chi2(table: TrackTable, k: int, p: Array, covariance: Array) -> float:
    """Squared Mahalanobis distance of p from the last position of robot k, or from its start if never acquired."""
    position, own = table.states.p[k], table.states.P[k, POSITION, POSITION]
    if table.status[k] is None:
        start = table.robots[k].start_m
        if start is None:
            return 0.0
        position, own = np.array(start), START_M**2 * np.eye(3)
    error = p - position
    return float(error @ np.linalg.solve(own + covariance, error))
