# SPDX-License-Identifier: BSD-3-Clause
"""Instants in, robots and markers out: the same code live and offline, without a clock of its own."""

import msgspec
import numpy as np
from numpy.typing import NDArray

from calib.camera import Camera
from fusion.association import match
from fusion.estimator import Estimator, Prediction, misfit
from fusion.instants import Instant
from fusion.messages import State
from fusion.optics import Optics
from fusion.report import Fused, report
from fusion.robots import Robot
from fusion.search import BIRTH, BIRTH_S, MAX_CHI2, SLACK_PX, Search
from fusion.sightings import Catalogue, Matches, Observations, Sightings
from fusion.state import POSITION, States

Array = NDArray[np.float64]
MAX_COAST_S = 30.0  # a covariance needs to grow no longer than this
FOLLOWED_M = 0.1  # of a position's standard deviation: one predicted worse is searched for by its shape


class Limits(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What may be tuned; the defaults suit printed roundels and calibrated cameras."""

    sigma_floor_px: float = 0.08  # added to the noise that detectors claim
    lost_after_s: float = 0.3  # without an observation
    lateness_ms: float = 150.0  # how long an instant waits for a camera: USB ones may be 100 ms behind
    tracked_sigma_m: float = (
        0.05  # a robot whose position is known worse is `coasting`, though a camera sees it
    )


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
        single = np.array([robot.is_single for robot in self.robots])
        densities = np.array([robot.densities for robot in self.robots])
        self.estimator = Estimator(self.optics, densities, single)
        n = len(self.robots)
        self.states = States.at_rest(np.tile(np.eye(3), (n, 1, 1)), np.zeros((n, 3)), BIRTH)
        self.status: list[State | None] = [None] * n  # None before a robot was ever found
        self.search = Search(self)
        self._seen_ns = np.zeros(n, np.int64)
        self._t_ns: int | None = None

    def fuse(self, instant: Instant) -> Fused:
        """Follow the robots into this instant, and look for those that are not tracked."""
        prediction = self._predict(instant.t_ns)
        sightings = Sightings.of(instant, self.optics, self.limits.sigma_floor_px)
        followed = self._followed(prediction.states)
        matches = match(self.optics, prediction.states, self.catalogue, followed, sightings)
        matches = self._update(prediction, sightings, matches)
        matches, free = self.search.find(np.flatnonzero(~followed), sightings, matches)
        self._note(instant.t_ns, matches)
        return report(self, instant, sightings, matches, free)

    def _predict(self, t_ns: int) -> Prediction:
        dt = BIRTH_S if self._t_ns is None else max((t_ns - self._t_ns) * 1e-9, BIRTH_S)
        self._t_ns = t_ns
        return self.estimator.predict(self.states, np.full(len(self.robots), min(dt, MAX_COAST_S)))

    def _followed(self, states: States) -> NDArray[np.bool_]:
        """(N,) robots that are where they are predicted to be, near enough to name their markers by it."""
        alive = np.array([status in ("tracked", "coasting") for status in self.status])
        sigma2 = np.einsum("nii->n", states.P[:, POSITION, POSITION]) / 3
        return alive & (sigma2 < FOLLOWED_M**2)

    def _update(self, prediction: Prediction, sightings: Sightings, matches: Matches) -> Matches:
        """Take what was matched; a robot that its own markers contradict stays as predicted, and has none."""
        observations = Observations.of(matches, sightings, self.catalogue)
        self.states, remainder = self.estimator.update(prediction, observations)
        matches = matches.remaining(remainder)
        wrong = misfit(observations, remainder, SLACK_PX, len(self.robots)) > MAX_CHI2
        if not wrong.any():
            return matches
        bad = np.flatnonzero(wrong)
        self.states = self.states.with_rows(bad, prediction.states.select(bad))
        return matches.select(~wrong[observations.discs.body])

    def _note(self, t_ns: int, matches: Matches) -> None:
        """Keep the states' names: tracked while seen well, coasting for a while without, then lost."""
        seen = np.zeros(len(self.robots), bool)
        seen[self.catalogue.robot[matches.disc]] = True
        self._seen_ns[seen] = t_ns
        silent = (t_ns - self._seen_ns) * 1e-9 > self.limits.lost_after_s
        worst = np.linalg.eigvalsh(self.states.P[:, POSITION, POSITION])[:, -1]
        vague = worst > self.limits.tracked_sigma_m**2
        for k, status in enumerate(self.status):
            if seen[k]:
                self.status[k] = "coasting" if vague[k] else "tracked"
            elif status in ("tracked", "coasting"):
                self.status[k] = "lost" if silent[k] else "coasting"
                if silent[k]:
                    self.states.v[k] = self.states.omega[k] = 0

    def adopt(self, rows: NDArray[np.intp], states: States) -> None:
        """Robots that were found stand there from now on."""
        self.states = self.states.with_rows(rows, states)
        for k in rows:
            self.status[k] = "tracked"
