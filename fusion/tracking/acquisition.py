# SPDX-License-Identifier: BSD-3-Clause
"""Robots that are not followed, looked for among the detections that nothing claims.

Constellations by the distances between their markers, and by where they were last; then robots of one marker, by size
and reach. What fits two robots alike stays nobody's.
"""

from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from camera_node.arrays import Array, Index, Mask
from fusion.model.camera_array import CameraArray
from fusion.model.observations import Assignments, DetectionTable, MarkerTable, MatchedObservations
from fusion.model.robots import Robot
from fusion.model.states import POSITION, States
from fusion.protocol.messages import TrackingState
from fusion.protocol.shards import Shard
from fusion.tracking.constellation import Fit, fits_size, identify
from fusion.tracking.estimator import Estimator, mean_of_bodies, misfit
from fusion.tracking.multiview import Marker, group
from fusion.tracking.normals import find_normal, rotation_to

BIRTH = (0.2, 0.05, 4.0, 1.5)  # sigmas of a robot just found: rad, m, rad/s, m/s
BIRTH_SINGLE = (0.3, 0.05, 10.0, 1.5)
BIRTH_S = 1e-3  # the motion model needs a time to act over, however short
BIRTH_SMALL = 1e-3
MAX_CHI2 = 8.0  # mean squared Mahalanobis error of a robot's markers, with SLACK_PX for the calibration
SLACK_PX = 0.7
HINT_SIGMA_M = 0.1  # of `start_m`
REACH = 16.3  # chi-square with 3 degrees, one in a thousand: where a lost single marker may be found again
FAR = 50.0  # chi-square of a constellation that is nowhere near where it was: it may have been carried
FLOOD = 600  # free detections of a frame: one with more shows a texture, or is a fault, and is not searched
BODIES = 12  # constellations that are looked for in one instant; the others' turn is next


class Followed(Protocol):
    """What a search needs of a tracker."""

    optics: CameraArray
    catalogue: MarkerTable
    robots: list[Robot]
    estimator: Estimator
    states: States
    status: list[TrackingState | None]
    owned: Mask
    shard: Shard

    def adopt(self, rows: Index, states: States) -> None: ...


@dataclass(frozen=True, slots=True, eq=False)
class _Birth:
    """A robot that seems to stand at R, p, by these matches."""

    robot: int
    R: Array
    p: Array
    matches: Assignments


@dataclass(frozen=True, slots=True, eq=False)
class _Trial:
    """Births refined, row by row: where they are then, and of each observation the match and the squared misfit."""

    states: States
    observations: MatchedObservations
    matches: Assignments
    misfit: Array


class Acquisition:
    """Looks for a tracker's missing robots."""

    def __init__(self, tracker: Followed) -> None:
        self.tracker = tracker
        self._turn = 0

    def find(
        self, missing: Index, sightings: DetectionTable, matches: Assignments
    ) -> tuple[Assignments, list[Marker]]:
        """The matches with those of the robots found, and the markers that stay nobody's: these tells the leader."""
        if not len(missing) and not self.tracker.shard.leads:
            return matches, []
        single = self.tracker.estimator.single
        bodies, singles = missing[~single[missing]], missing[single[missing]]
        if len(bodies):
            matches = self._find_bodies(bodies, sightings, matches)
        markers = self._group(sightings, matches)
        if len(singles):
            matches, markers = self._find_singles(singles, markers, sightings, matches)
        return matches, markers

    def _find_bodies(self, missing: Index, sightings: DetectionTable, matches: Assignments) -> Assignments:
        """The matches with those of the constellations found, whose markers may have passed for single ones."""
        matches, aside = self._without_singles(matches)
        markers = self._group(sightings, matches)
        tracker = self.tracker
        turn = np.roll(missing, -self._turn)[:BODIES]
        self._turn = (self._turn + BODIES) % len(missing) if len(missing) > BODIES else 0

        def born(fit: Fit) -> _Birth:
            claimed = self._claim(fit.robot, fit.numbers, [markers[p] for p in fit.points])
            return _Birth(fit.robot, fit.R, fit.t, claimed)

        def judge(fits: list[Fit]) -> Array:
            births = [born(fit) for fit in fits]
            trial = self._refine(births, sightings, BIRTH)
            return np.bincount(trial.observations.discs.body, trial.misfit, len(births)).astype(float)

        bodies = {int(k): tracker.robots[k] for k in turn}
        fits = identify(bodies, markers, self._faces, self._history, judge)
        births = [born(fit) for fit in fits if tracker.owned[fit.robot]]
        return self._with_singles(matches.joined(self._bear(births, sightings, BIRTH)), aside)

    def _find_singles(
        self, missing: Index, markers: list[Marker], sightings: DetectionTable, matches: Assignments
    ) -> tuple[Assignments, list[Marker]]:
        births = []
        pairs = self._pair_singles(missing.tolist(), markers)
        for robot, marker in pairs:
            normal = find_normal(
                self.tracker.optics, sightings, marker, self.tracker.robots[robot].diameter_m / 2
            )
            R = rotation_to(self._towards(marker) if normal is None else normal)
            births.append(_Birth(robot, R, marker.position, self._claim(robot, (0,), [marker])))
        born = self._bear(births, sightings, BIRTH_SINGLE)
        taken = set(born.sighting.tolist())
        return matches.joined(born), [m for m in markers if not taken.intersection(m.sightings.tolist())]

    def _group(self, sightings: DetectionTable, matches: Assignments) -> list[Marker]:
        """Markers out of the detections that nothing claims."""
        free = np.ones(len(sightings), bool)
        free[matches.sighting] = False
        count = np.bincount(sightings.frame[free], minlength=len(sightings.exposures.camera))
        free &= (count <= FLOOD)[sightings.frame]
        sizes = np.unique(2 * self.tracker.catalogue.radius)
        return (
            group(self.tracker.optics, sightings, np.flatnonzero(free), sizes)
            if free.any() and len(sizes)
            else []
        )

    def _claim(self, robot: int, numbers: tuple[int, ...], markers: list[Marker]) -> Assignments:
        """These markers' sightings are of the robot's markers `numbers`."""
        discs = self.tracker.catalogue.first[robot] + np.array(numbers, np.intp)
        counts = [len(marker.sightings) for marker in markers]
        return Assignments.of(np.concatenate([m.sightings for m in markers]), np.repeat(discs, counts))

    def _without_singles(self, matches: Assignments) -> tuple[Assignments, Assignments]:
        single = self.tracker.estimator.single[self.tracker.catalogue.robot[matches.disc]]
        return matches.select(~single), matches.select(single)

    def _with_singles(self, matches: Assignments, aside: Assignments) -> Assignments:
        """Give back what robots of one marker had, except what a constellation proved to be its own."""
        stolen = np.isin(aside.sighting, matches.sighting)
        robbed = np.unique(aside.disc[stolen])
        for disc in robbed:
            self.tracker.status[self.tracker.catalogue.robot[disc]] = "lost"
        return matches.joined(aside.select(~np.isin(aside.disc, robbed)))

    def _pair_singles(self, lost: list[int], markers: list[Marker]) -> list[tuple[int, Marker]]:
        """Robots of one marker and theirs, where within reach there is one robot to one marker; else none."""
        within = np.array([[self._reaches(k, marker) for marker in markers] for k in lost], bool)
        within = within.reshape(len(lost), len(markers))
        owned = self.tracker.owned
        return [
            (k, markers[int(np.argmax(row))])
            for k, row in zip(lost, within, strict=True)
            if owned[k] and row.sum() == 1 and within[:, np.argmax(row)].sum() == 1
        ]

    def _reaches(self, k: int, marker: Marker) -> bool:
        """Whether a lost robot of one marker can be this one: by size, and by where it was or starts."""
        if not fits_size(marker, self.tracker.robots[k]):
            return False
        return self._distance(k, marker.position, marker.covariance) < REACH

    def _history(self, k: int, p: Array) -> float:
        """Chi-square of robot k's standing at p; one that is far away may have been carried there."""
        return min(self._distance(k, p, np.zeros((3, 3))), FAR)

    def _distance(self, k: int, p: Array, covariance: Array) -> float:
        """Squared Mahalanobis distance of p from where robot k was or, before it was ever found, starts."""
        place, own = self.tracker.states.p[k], self.tracker.states.P[k, POSITION, POSITION]
        if self.tracker.status[k] is None:
            start = self.tracker.robots[k].start_m
            if start is None:
                return 0.0
            place, own = np.array(start), HINT_SIGMA_M**2 * np.eye(3)
        error = p - place
        return float(error @ np.linalg.solve(own + covariance, error))

    def _bear(self, births: list[_Birth], sightings: DetectionTable, sigmas: tuple) -> Assignments:
        """Start robots at these poses, refined by their observations; the matches of those that agree."""
        if not births:
            return Assignments.none()
        trial = self._refine(births, sightings, sigmas)
        body = trial.observations.discs.body
        good = mean_of_bodies(trial.misfit, body, len(births)) < MAX_CHI2
        self.tracker.adopt(np.array([birth.robot for birth in births])[good], trial.states.select(good))
        return trial.matches.select(good[body])

    def _refine(self, births: list[_Birth], sightings: DetectionTable, sigmas: tuple) -> "_Trial":
        """Each birth by itself, its robot's body and speed by its observations."""
        at = States.at_rest(np.array([b.R for b in births]), np.array([b.p for b in births]), sigmas)
        parts = [birth.matches for birth in births]
        matches = Assignments(
            *(np.concatenate([getattr(m, k) for m in parts]) for k in Assignments.__slots__)
        )
        observations = MatchedObservations.of(matches, sightings, self.tracker.catalogue)
        body = np.repeat(np.arange(len(births)), [len(part) for part in parts])
        observations = replace(observations, discs=replace(observations.discs, body=body))
        estimator = self.tracker.estimator.select(np.array([birth.robot for birth in births]))
        prediction = estimator.predict(at, np.full(len(births), BIRTH_S))
        found, remainder = estimator.update(prediction, observations, BIRTH_SMALL)
        d2 = misfit(observations, remainder, SLACK_PX)
        return _Trial(found, observations, matches.remaining(remainder), d2)

    def _faces(self, marker: Marker, normal: Array) -> bool:
        """Whether a marker with this normal shows its print to the cameras that saw it."""
        return bool(((self.tracker.optics.centres[marker.cameras] - marker.position) @ normal > 0).all())

    def _towards(self, marker: Marker) -> Array:
        """The mean direction of the cameras that saw a marker."""
        to = self.tracker.optics.centres[np.unique(marker.cameras)] - marker.position
        mean = (to / np.linalg.norm(to, axis=1, keepdims=True)).sum(0)
        return mean / np.linalg.norm(mean)
