# SPDX-License-Identifier: BSD-3-Clause
"""Instants in, robots and markers out: the same code live and offline, without a clock of its own."""

import msgspec
import numpy as np
from numpy.typing import NDArray

from calib.camera import Camera
from camera_node.pose import rotation_from_wxyz
from fusion.association import match
from fusion.estimator import Estimator, Prediction, mean_of_bodies, misfit
from fusion.instants import Frame, Instant
from fusion.messages import RobotPose, State
from fusion.optics import Exposures, Optics
from fusion.report import Fused, Move, report
from fusion.robots import Robot
from fusion.search import BIRTH, BIRTH_S, MAX_CHI2, SLACK_PX, Search
from fusion.shards import Shard
from fusion.sightings import Catalogue, Matches, Observations, Sightings
from fusion.state import POSITION, States, exp_so3
from fusion.watch import Expected, Watch

Array = NDArray[np.float64]
MAX_COAST_S = 30.0  # a covariance needs to grow no longer than this
WATCHED = 40  # markers that are compared with their images in one instant, about
WATCH_FACING, WATCH_MARGIN_PX = 0.35, 30.0  # what a camera surely sees
CONTRADICTED = 0.5  # share of a robot's detections that miss it: more, and they are not its own
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
        shard: which of the robots are estimated here; `follow` tells of the others.
    """

    def __init__(
        self,
        cameras: dict[str, Camera],
        robots: dict[str, Robot],
        limits: Limits | None = None,
        shard: Shard = Shard(),  # noqa: B008 frozen
    ) -> None:
        self.optics = Optics(cameras)
        self.names, self.robots = tuple(robots), list(robots.values())
        self.limits, self.shard = limits or Limits(), shard
        self.owned = np.array([shard.owns(name) for name in self.names], bool)
        self.catalogue = Catalogue.of(self.robots)
        single = np.array([robot.is_single for robot in self.robots])
        densities = np.array([robot.densities for robot in self.robots])
        self.estimator = Estimator(self.optics, densities, single)
        n = len(self.robots)
        self.states = States.at_rest(np.tile(np.eye(3), (n, 1, 1)), np.zeros((n, 3)), BIRTH)
        self.status: list[State | None] = [None] * n  # None before a robot was ever found
        self.search = Search(self)
        self.watch = Watch()
        self._watched = 0
        self._last: tuple[Instant, Sightings, Matches] | None = None
        self.predicted: tuple[Prediction, NDArray[np.bool_]]  # of the last instant, and of which robots it is
        self._seen, self._seen_ns = np.zeros(n, bool), np.zeros(n, np.int64)
        self._t_ns: int | None = None

    def fuse(self, instant: Instant) -> Fused:
        """Follow the robots into this instant, and look for those that are not tracked."""
        prediction = self._predict(instant.t_ns)
        trusted = Instant(instant.t_ns, tuple(f for f in instant.frames if f.camera not in self.watch.bumped))
        sightings = Sightings.of(trusted, self.optics, self.limits.sigma_floor_px)
        followed = self._followed(prediction.states)
        self.predicted = prediction, followed
        matches = match(self.optics, prediction.states, self.catalogue, followed, sightings)
        matches = self._update(prediction, sightings, matches)
        matches, free = self.search.find(np.flatnonzero(~followed), sightings, matches)
        self._note(instant.t_ns, matches)
        self._last = instant, sightings, matches
        return report(self, trusted, sightings, matches, free)

    def with_robots(self, robots: dict[str, Robot], renamed: dict[str, str]) -> "Tracker":
        """A tracker of other robots before the same cameras; those it knows by name and markers stay as they are.

        Args:
            robots: the new ones, by name.
            renamed: old name -> new name.
        """
        other = Tracker(
            dict(zip(self.optics.names, self.optics.cameras, strict=True)), robots, self.limits, self.shard
        )
        other.watch, other._t_ns = self.watch, self._t_ns
        old = {renamed.get(name, name): k for k, name in enumerate(self.names)}
        for row, (name, robot) in enumerate(robots.items()):
            k = old.get(name)
            if k is None or self.robots[k].markers != robot.markers:
                continue
            other.states = other.states.with_rows(np.array([row]), self.states.select(np.array([k])))
            other.status[row], other._seen_ns[row] = self.status[k], self._seen_ns[k]
            other._seen[row] = self._seen[k]
        return other

    def place(self, name: str, camera: Camera) -> None:
        """A camera stands elsewhere from now on; robots stay as they are."""
        self.optics.place(name, camera)

    def inspect(self) -> tuple[Move, ...]:
        """After an instant was told: compare frames with what robots seen by two other cameras should look like.

        Places a camera anew that was moved; says which were, and where they stand.
        """
        if self._last is None:
            return ()
        instant, sightings, matches = self._last
        seen = np.zeros((len(self.robots), len(self.optics.names)), bool)
        seen[self.catalogue.robot[matches.disc], sightings.camera[matches.sighting]] = True
        steady = np.array([status == "tracked" for status in self.status])
        for frame in self._turn(instant.frames):
            camera = self.optics.index[frame.camera]
            others = seen.sum(1) - seen[:, camera]
            markers = np.flatnonzero((steady & (others >= 2))[self.catalogue.robot])
            markers = np.roll(markers, -self._watched)[:WATCHED]
            points = self._expect(frame, camera, (frame.t_ns - instant.t_ns) * 1e-9, markers)
            if points.shape[1]:
                self.watch.note(self.optics.cameras[camera], Expected(frame, points))
        return self._heal()

    def _turn(self, frames: tuple[Frame, ...]) -> tuple[Frame, ...]:
        """Some of the frames, others in the next instant, so that watching costs the same in a large arena."""
        n = max(1, WATCHED // max(len(self.catalogue.robot), 1))
        first = self._watched % max(len(frames), 1)
        self._watched += n
        return (frames + frames)[first : first + min(n, len(frames))]

    def _expect(self, frame: Frame, camera: int, tau: float, markers: NDArray[np.intp]) -> Array:
        """(3, N) points in the world whose projections are the outlines' centres that the frame should show."""
        exposures = Exposures(np.array([camera]), np.array([tau]))
        discs = self.catalogue.discs(markers, np.zeros(len(markers), np.intp))
        views = self.optics.view(self.optics.pose(self.states, exposures), discs)
        points = self.optics.R_cam_world[camera].T @ views.q + self.optics.centres[camera][:, None]
        lens = self.optics.cameras[camera]
        uv = lens.project(views.q.T)
        inside = ((uv > WATCH_MARGIN_PX) & (uv < np.array([lens.width, lens.height]) - WATCH_MARGIN_PX)).all(
            1
        )
        return points[:, inside & (views.facing > WATCH_FACING)]

    def _heal(self) -> tuple[Move, ...]:
        moves = []
        if (name := self.watch.find_bumped()) is not None:
            moves.append(Move(name, None))
        for name in sorted(self.watch.bumped) if self.shard.leads else ():
            camera = self.watch.heal(name, self.optics.cameras[self.optics.index[name]])
            if camera is not None:
                self.place(name, camera)
                moves.append(Move(name, camera))
        return tuple(moves)

    def _predict(self, t_ns: int) -> Prediction:
        dt = BIRTH_S if self._t_ns is None else max((t_ns - self._t_ns) * 1e-9, BIRTH_S)
        self._t_ns = t_ns
        return self.estimator.predict(self.states, np.full(len(self.robots), min(dt, MAX_COAST_S)))

    def _followed(self, states: States) -> NDArray[np.bool_]:
        """(N,) robots that are where they are predicted to be, near enough to name their markers by it.

        One that was seen just now is, in the camera that saw it, however badly its range is known.
        """
        alive = np.array([status in ("tracked", "coasting") for status in self.status])
        sigma2 = np.einsum("nii->n", states.P[:, POSITION, POSITION]) / 3
        return alive & ((sigma2 < FOLLOWED_M**2) | self._seen)

    def _update(self, prediction: Prediction, sightings: Sightings, matches: Matches) -> Matches:
        """Take what was matched; a robot that its own markers contradict stays as predicted, and has none."""
        mine = self.owned[self.catalogue.robot[matches.disc]]
        others, matches = matches.select(~mine), matches.select(mine)
        states, matches = self._fit(prediction, sightings, matches)
        if self.watch.is_strange(matches.squared_px):
            states, matches = self._without_a_camera(prediction, sightings, matches, states)
        else:
            self.watch.learn(matches.squared_px)
        self.states = states
        return matches.joined(others)

    def _fit(self, prediction: Prediction, sightings: Sightings, matches: Matches) -> tuple[States, Matches]:
        observations = Observations.of(matches, sightings, self.catalogue)
        states, remainder = self.estimator.update(prediction, observations)
        matches = matches.remaining(remainder)
        misses = misfit(observations, remainder, SLACK_PX) > MAX_CHI2
        wrong = mean_of_bodies(misses, observations.discs.body, len(self.robots)) > CONTRADICTED
        if not wrong.any():
            return states, matches
        bad = np.flatnonzero(wrong)
        states = states.with_rows(bad, prediction.states.select(bad))
        return states, matches.select(~wrong[observations.discs.body])

    def _without_a_camera(
        self, prediction: Prediction, sightings: Sightings, matches: Matches, states: States
    ) -> tuple[States, Matches]:
        """Robots by all cameras but the one that contradicts the others, if there is one."""
        for name in self.watch.suspects(self.optics.names):
            others = sightings.camera[matches.sighting] != self.optics.index[name]
            if others.all():
                continue
            fitted, rest = self._fit(prediction, sightings, matches.select(others))
            if self.watch.explains(name, rest.squared_px, matches.squared_px):
                return fitted, rest
        self.watch.learn(matches.squared_px)
        return states, matches

    def _note(self, t_ns: int, matches: Matches) -> None:
        """Keep the states' names: tracked while seen well, coasting for a while without, then lost."""
        seen = np.zeros(len(self.robots), bool)
        seen[self.catalogue.robot[matches.disc]] = True
        self._seen, self._seen_ns[seen & self.owned] = seen, t_ns
        silent = (t_ns - self._seen_ns) * 1e-9 > self.limits.lost_after_s
        worst = np.linalg.eigvalsh(self.states.P[:, POSITION, POSITION])[:, -1]
        vague = worst > self.limits.tracked_sigma_m**2
        for k, status in enumerate(self.status):
            if not self.owned[k]:
                self.status[k] = "lost" if status is not None and silent[k] else status
            elif seen[k]:
                self.status[k] = "coasting" if vague[k] else "tracked"
            elif status in ("tracked", "coasting"):
                self.status[k] = "lost" if silent[k] else "coasting"
                if silent[k]:
                    self.states.v[k] = self.states.omega[k] = 0

    def follow(self, pose: RobotPose) -> None:
        """Another shard's robot is there: its detections are its own, and not for ours."""
        if pose.robot not in self.names or self._t_ns is None:
            return
        k = self.names.index(pose.robot)
        if self.owned[k] or pose.t_ns <= self._seen_ns[k]:
            return
        dt = (self._t_ns - pose.t_ns) * 1e-9
        omega, v = np.array([pose.angular_velocity]), np.array([pose.velocity])
        R = exp_so3(omega * dt) @ rotation_from_wxyz(pose.quaternion_wxyz)
        there = States(R, pose.position + v * dt, omega, v, pose.covariance_matrix[None])
        self.states = self.states.with_rows(np.array([k]), there)
        self.status[k], self._seen_ns[k] = pose.state, pose.t_ns

    def adopt(self, rows: NDArray[np.intp], states: States) -> None:
        """Robots that were found stand there from now on."""
        self.states = self.states.with_rows(rows, states)
        for k in rows:
            self.status[k] = "tracked"
