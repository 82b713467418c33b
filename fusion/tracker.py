# SPDX-License-Identifier: BSD-3-Clause
"""Instants in, robots and markers out: the same code live and offline, without a clock of its own."""

from dataclasses import replace

import msgspec
import numpy as np
from numpy.typing import NDArray

from calib.camera import Camera
from fusion.association import Catalogue, Matches, Sightings, match
from fusion.estimator import Estimator
from fusion.grouping import Marker, group
from fusion.instants import Instant
from fusion.messages import State
from fusion.normals import find_normal, rotation_to
from fusion.optics import Optics
from fusion.report import Fused, report
from fusion.robots import Robot
from fusion.signature import fits_size, identify
from fusion.state import POSITION, States

Array = NDArray[np.float64]
Index = NDArray[np.intp]
BIRTH = (0.2, 0.05, 4.0, 1.5)  # sigmas of a robot just found: rad, m, rad/s, m/s
BIRTH_SINGLE = (0.3, 0.05, 10.0, 1.5)
BIRTH_S = 1e-3  # the motion model needs a time to act over, however short
BIRTH_ITERATIONS = 6
MAX_CHI2 = 8.0  # mean squared Mahalanobis error of a birth, with SLACK_PX for the calibration
SLACK_PX = 0.7
HINT_SIGMA_M = 0.1  # of `start_m`
REACH = 16.3  # chi-square with 3 degrees, one in a thousand: where a lost single marker may be found again
MAX_COAST_S = 30.0  # a covariance needs to grow no longer than this


class Limits(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What may be tuned; the defaults suit printed roundels and calibrated cameras."""

    sigma_floor_px: float = 0.08  # added to the noise that detectors claim
    lost_after_s: float = 0.3  # without an observation
    lateness_ms: float = 150.0  # how long an instant waits for a camera: USB ones may be 100 ms behind


class Tracker:
    """Follows robots from instant to instant.

    Args:
        cameras: the placed cameras; frames of others must not come.
        robots: by name, as `load_robots` checked them.
        limits: see `Limits`.
    """

    def __init__(
        self, cameras: dict[str, Camera], robots: dict[str, Robot], limits: Limits | None = None
    ) -> None:
        self.optics = Optics(cameras)
        self.names, self.robots = tuple(robots), list(robots.values())
        self.limits = limits or Limits()
        self.catalogue = Catalogue.of(self.robots)
        self._single = np.array([robot.is_single for robot in self.robots])
        densities = np.array([robot.densities for robot in self.robots])
        self.estimator = Estimator(self.optics, densities, self._single)
        n = len(self.robots)
        self.states = States.at_rest(np.tile(np.eye(3), (n, 1, 1)), np.zeros((n, 3)), BIRTH)
        self.status: list[State | None] = [None] * n  # None before a robot was ever found
        self._seen_ns = np.zeros(n, np.int64)
        self._t_ns: int | None = None

    def fuse(self, instant: Instant) -> Fused:
        """Follow the robots into this instant, and look for those that are not tracked."""
        prediction = self._predict(instant.t_ns)
        sightings = Sightings.of(instant, self.optics, self.limits.sigma_floor_px)
        active = np.array([status in ("tracked", "coasting") for status in self.status])
        matches = match(self.optics, prediction.states, self.catalogue, active, sightings)
        observations = matches.observations(sightings, self.catalogue)
        self.states = self.estimator.update(prediction, observations)
        matches, free = self._find(instant.t_ns, sightings, matches)
        self._note(instant.t_ns, matches)
        return report(self, instant, sightings, matches, free)

    def _predict(self, t_ns: int):
        dt = BIRTH_S if self._t_ns is None else max((t_ns - self._t_ns) * 1e-9, BIRTH_S)
        self._t_ns = t_ns
        return self.estimator.predict(self.states, np.full(len(self.robots), min(dt, MAX_COAST_S)))

    def _note(self, t_ns: int, matches: Matches) -> None:
        """Keep the states' names: tracked with observations, coasting for a while without, then lost."""
        seen = np.zeros(len(self.robots), bool)
        seen[self.catalogue.robot[matches.disc]] = True
        self._seen_ns[seen] = t_ns
        for k, status in enumerate(self.status):
            if seen[k]:
                self.status[k] = "tracked"
            elif status in ("tracked", "coasting"):
                silent = (t_ns - self._seen_ns[k]) * 1e-9 > self.limits.lost_after_s
                self.status[k] = "lost" if silent else "coasting"
                if silent:
                    self.states.v[k] = self.states.omega[k] = 0

    # Robots that are not tracked.

    def _find(self, t_ns: int, sightings: Sightings, matches: Matches) -> tuple[Matches, list[Marker]]:
        """Look for lost robots among detections that nothing claims: constellations first, then single markers.

        Returns the matches with theirs, and the markers that stay nobody's.
        """
        lost = [k for k, status in enumerate(self.status) if status in (None, "lost")]
        bodies = {k: self.robots[k] for k in lost if not self._single[k]}
        if bodies:
            matches = self._find_bodies(bodies, sightings, matches)
        markers = self._group(sightings, matches)
        for robot, marker in self._pair_singles([k for k in lost if self._single[k]], markers):
            born = _claim([marker], [np.flatnonzero(self.catalogue.robot == robot)[0]])
            normal = find_normal(self.optics, sightings, marker, self.robots[robot].diameter_m / 2)
            R = rotation_to(self._towards(marker) if normal is None else normal)
            if self._bear(robot, R, marker.position, sightings, born, BIRTH_SINGLE):
                matches = _joined(matches, born)
                markers = [other for other in markers if other is not marker]
        return matches, markers

    def _find_bodies(self, bodies: dict[int, Robot], sightings: Sightings, matches: Matches) -> Matches:
        """The matches with those of the constellations found, whose markers may have passed for single ones."""
        matches, aside = self._without_singles(matches)
        markers = self._group(sightings, matches)
        for fit in identify(bodies, markers, self._faces):
            discs = [np.flatnonzero(self.catalogue.robot == fit.robot)[n] for n in fit.numbers]
            born = _claim([markers[p] for p in fit.points], discs)
            if self._bear(fit.robot, fit.R, fit.t, sightings, born, BIRTH):
                matches = _joined(matches, born)
        return self._with_singles(matches, aside)

    def _group(self, sightings: Sightings, matches: Matches) -> list[Marker]:
        """Markers out of the detections that nothing claims."""
        free = np.setdiff1d(np.arange(len(sightings)), matches.sighting)
        return group(self.optics, sightings, free, np.unique(2 * self.catalogue.radius))

    def _without_singles(self, matches: Matches) -> tuple[Matches, Matches]:
        kept = ~self._single[self.catalogue.robot[matches.disc]]
        aside = Matches(matches.sighting[~kept], matches.disc[~kept])
        return Matches(matches.sighting[kept], matches.disc[kept]), aside

    def _with_singles(self, matches: Matches, aside: Matches) -> Matches:
        """Give back what robots of one marker had, except what a constellation proved to be its own."""
        stolen = np.isin(aside.sighting, matches.sighting)
        robbed = np.unique(aside.disc[stolen])
        for disc in robbed:
            self.status[self.catalogue.robot[disc]] = "lost"
        kept = ~np.isin(aside.disc, robbed)
        return _joined(matches, Matches(aside.sighting[kept], aside.disc[kept]))

    def _pair_singles(self, lost: list[int], markers: list[Marker]) -> list[tuple[int, Marker]]:
        """Robots of one marker and theirs, where within reach there is one robot to one marker; else none."""
        within = np.array([[self._reaches(k, marker) for marker in markers] for k in lost], bool)
        within = within.reshape(len(lost), len(markers))
        return [
            (k, markers[int(np.argmax(row))])
            for k, row in zip(lost, within, strict=True)
            if row.sum() == 1 and within[:, np.argmax(row)].sum() == 1
        ]

    def _reaches(self, k: int, marker: Marker) -> bool:
        """Whether a lost robot of one marker can be this one: by size, and by where it was or starts."""
        if not fits_size(marker, self.robots[k]):
            return False
        place, covariance = self.states.p[k], self.states.P[k, POSITION, POSITION]
        if self.status[k] is None:
            start = self.robots[k].start_m
            if start is None:
                return True
            place, covariance = np.array(start), HINT_SIGMA_M**2 * np.eye(3)
        error = marker.position - place
        return bool(error @ np.linalg.solve(covariance + marker.covariance, error) < REACH)

    def _bear(self, k: int, R: Array, p: Array, sightings: Sightings, born: Matches, sigmas: tuple) -> bool:
        """Start robot k at this pose, refined by its observations; False if they do not agree."""
        at = States.at_rest(R[None], p[None], sigmas)
        states = self.states.select(np.arange(len(self.robots)))
        states.store(np.array([k]), at)
        observations = born.observations(sightings, self.catalogue)
        prediction = self.estimator.predict(states, np.full(len(self.robots), BIRTH_S))
        found = self.estimator.update(prediction, observations, BIRTH_ITERATIONS)
        loose = replace(observations, cov=observations.cov + SLACK_PX**2 * np.eye(2))
        _, d2 = self.estimator.errors(found, loose)
        if not np.mean(d2) < MAX_CHI2:
            return False
        row = np.array([k])
        self.states.store(row, found.select(row))
        self.status[k] = "tracked"
        return True

    def _faces(self, marker: Marker, normal: Array) -> bool:
        """Whether a marker with this normal shows its print to the cameras that saw it."""
        cameras = np.unique(marker.cameras)
        return bool(((self.optics.centres[cameras] - marker.position) @ normal > 0).all())

    def _towards(self, marker: Marker) -> Array:
        """The mean direction of the cameras that saw a marker."""
        to = self.optics.centres[np.unique(marker.cameras)] - marker.position
        mean = (to / np.linalg.norm(to, axis=1, keepdims=True)).sum(0)
        return mean / np.linalg.norm(mean)


def _claim(markers: list[Marker], discs: list) -> Matches:
    counts = [len(marker.sightings) for marker in markers]
    return Matches(
        np.concatenate([m.sightings for m in markers]), np.repeat(np.array(discs, np.intp), counts)
    )


def _joined(a: Matches, b: Matches) -> Matches:
    return Matches(np.concatenate([a.sighting, b.sighting]), np.concatenate([a.disc, b.disc]))
