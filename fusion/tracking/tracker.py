# SPDX-License-Identifier: BSD-3-Clause
"""Instants in, robots and markers out: the same code live and offline, without a clock of its own."""

from dataclasses import dataclass

import msgspec
import numpy as np

from calib.rig.camera import Camera
from camera_node.arrays import Index, Mask
from fusion.model.camera_array import CameraArray
from fusion.model.frames import FrameSet
from fusion.model.observations import Assignments, DetectionTable, MarkerTable, MatchedObservations
from fusion.model.robots import Robot
from fusion.model.states import POSITION, THETA, States
from fusion.monitoring.extrinsics_monitor import ExtrinsicsMonitor
from fusion.monitoring.geometry_check import GeometryCheck
from fusion.monitoring.inspection import Inspection
from fusion.protocol.messages import RobotPose, ShardPoses, TrackingState
from fusion.protocol.shards import Shard, shard_poses_of, states_of
from fusion.tracking.acquisition import BIRTH, BIRTH_S, MAX_CHI2, SLACK_PX, Acquisition
from fusion.tracking.association import Association
from fusion.tracking.estimator import Estimator, Prediction, mean_of_bodies, misfit
from fusion.tracking.result import Fused, Move, Seen, look, report, tell_poses
from fusion.tracking.single_view import SingleViewTracker
from fusion.tracking.unlabeled import UnlabeledTracker

MAX_COAST_S = 30.0  # a covariance needs to grow no longer than this
CONTRADICTED = 0.5  # share of a robot's detections that miss it: more, and they are not its own
FOLLOWED_M = 0.1  # of a position's standard deviation: one predicted worse is searched for by its shape
FOLLOWED_RAD = 0.15  # of its turn: a constellation turned further looks as if its markers were swapped
OTHERS = 1000  # messages of other shards that wait for an instant, at the most


class Limits(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What may be tuned; the defaults suit printed roundels and calibrated cameras."""

    sigma_floor_px: float = 0.08  # added to the noise that detectors claim
    lost_after_s: float = 0.3  # without an observation
    lateness_ms: float = 150.0  # how long an instant waits for a camera: USB ones may be 100 ms behind
    tracked_sigma_m: float = 0.05  # a robot whose position is known worse is `coasting`, though it is seen


@dataclass(frozen=True, slots=True, eq=False)
class _Begun:
    """An instant before it is whole: the robots' prediction, which of them are followed (N,), and what is matched."""

    t_ns: int
    prediction: Prediction
    followed: Mask
    association: Association


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
        self.optics = CameraArray(cameras)
        self.names, self.robots = tuple(robots), list(robots.values())
        self._row = {name: k for k, name in enumerate(robots)}
        self.limits, self.shard = limits or Limits(), shard
        self.owned = np.array([shard.owns(name) for name in self.names], bool)
        self.catalogue = MarkerTable.of(self.robots)
        single = np.array([robot.is_single for robot in self.robots])
        densities = np.array([robot.densities for robot in self.robots])
        self.estimator = Estimator(self.optics, densities, single)
        n = len(self.robots)
        self.states = States.at_rest(np.tile(np.eye(3), (n, 1, 1)), np.zeros((n, 3)), BIRTH)
        self.status: list[TrackingState | None] = [None] * n  # None before a robot was ever found
        self.search = Acquisition(self)
        self.loose = UnlabeledTracker(self.optics, self.catalogue.radius)
        self.single_views = SingleViewTracker(self.optics, self.catalogue.radius)
        self.watch = ExtrinsicsMonitor()
        self.shapes = GeometryCheck(self.names, single)
        self._inspection = Inspection(self)
        self._last: tuple[FrameSet, DetectionTable, Assignments, Seen] | None = None
        self.predicted: tuple[Prediction, Mask]  # of the last instant, and of which robots it is
        self._seen, self._seen_ns = np.zeros(n, bool), np.zeros(n, np.int64)
        self._t_ns: int | None = None
        self._begun: _Begun | None = None  # the instant that comes next
        self._told: dict[int, RobotPose] = {}  # of the last instant, before it was complete
        self._others: list[ShardPoses] = []  # of other shards, since the last instant was begun

    def fuse(self, instant: FrameSet) -> Fused:
        """Follow the robots into this instant, and look for those that are not tracked."""
        self.advance(instant)
        return self.complete()

    def anticipate(self, instant: FrameSet, owed: int) -> None:
        """Do what can be done of an instant of which `owed` frames are still to come.

        A round costs as much as some frames: one waits for more frames than are then left, of eight for five, then two.
        """
        association, trusted = self._begin(instant.t_ns).association, self._trusted(instant)
        if len(association.missing(trusted.frames)) > owed > 0:
            association.add(trusted.frames)

    def advance(self, instant: FrameSet) -> tuple[RobotPose, ...]:
        """Follow the robots into this instant; the poses that no search can change any more."""
        begun = self._begin(instant.t_ns)
        self._begun, self._t_ns = None, instant.t_ns
        self.predicted = begun.prediction, begun.followed
        trusted = self._trusted(instant)
        sightings, matches = begun.association.whole(trusted)
        matches = self._update(begun.prediction, sightings, matches)
        self._note(instant.t_ns, matches)
        rows = np.flatnonzero(begun.followed & ~(self.estimator.single & self._misses_bodies(begun.followed)))
        seen = look(self, sightings, matches)
        self.shapes.note(seen.residual_px)
        self._told = tell_poses(self, instant.t_ns, seen, rows.tolist())
        self._last = instant, sightings, matches, seen
        return tuple(self._told.values())

    def complete(self) -> Fused:
        """After `advance`: look for robots that are not tracked, and tell the whole instant."""
        assert self._last is not None
        instant, sightings, matches, seen = self._last
        missing = np.flatnonzero(~self.predicted[1])
        missing = missing if self.owned[missing].any() else missing[:0]  # others look for their own
        n_known = len(matches)
        matches, free = self.search.find(missing, sightings, matches)
        if len(matches) != n_known:
            self._note(instant.t_ns, matches)
        if len(missing):
            seen = look(self, sightings, matches)
        self._last = instant, sightings, matches, seen
        loose = self.loose.follow(instant.t_ns, sightings, free)
        loose = self.single_views.complete(self, instant.t_ns, sightings, matches, loose)
        return report(self, self._trusted(instant), sightings, matches, seen, loose, self._told)

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
        self._begun = None

    def inspect(self) -> tuple[Move, ...]:
        """After an instant was told: which cameras are found to be moved, and where they stand; see `Inspection`."""
        return () if self._last is None else self._inspection.inspect(*self._last[:3])

    def _begin(self, t_ns: int) -> "_Begun":
        """The instant at `t_ns`, begun now if it was not yet."""
        if self._begun is None or self._begun.t_ns != t_ns:
            self._take_others()
            prediction = self._predict(t_ns)
            followed = self._followed(prediction.states)
            scene = self.optics, self.catalogue, prediction.states, followed
            association = Association(*scene, t_ns, self.limits.sigma_floor_px)
            self._begun = _Begun(t_ns, prediction, followed, association)
        return self._begun

    def _trusted(self, instant: FrameSet) -> FrameSet:
        """The instant without the frames of cameras that are set aside."""
        if not self.watch.bumped:
            return instant
        return FrameSet(instant.t_ns, tuple(f for f in instant.frames if f.camera not in self.watch.bumped))

    def _misses_bodies(self, followed: Mask) -> bool:
        """Whether constellations are looked for, which may prove that a single robot's marker is their own."""
        return bool((~followed & ~self.estimator.single).any())

    def _predict(self, t_ns: int) -> Prediction:
        dt = BIRTH_S if self._t_ns is None else max((t_ns - self._t_ns) * 1e-9, BIRTH_S)
        return self.estimator.predict(self.states, np.full(len(self.robots), min(dt, MAX_COAST_S)))

    def _followed(self, states: States) -> Mask:
        """(N,) robots that are where they are predicted to be, near enough to name their markers by it.

        One that was seen just now is, in the camera that saw it, however badly its range is known.
        """
        alive = np.array([status in ("tracked", "coasting") for status in self.status])
        place2, turn2 = (np.einsum("nii->n", states.P[:, part, part]) / 3 for part in (POSITION, THETA))
        turned = (turn2 > FOLLOWED_RAD**2) & ~self.estimator.single
        return alive & ((place2 < FOLLOWED_M**2) & ~turned | self._seen)

    def _update(self, prediction: Prediction, sightings: DetectionTable, matches: Assignments) -> Assignments:
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

    def _fit(
        self, prediction: Prediction, sightings: DetectionTable, matches: Assignments
    ) -> tuple[States, Assignments]:
        observations = MatchedObservations.of(matches, sightings, self.catalogue)
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
        self, prediction: Prediction, sightings: DetectionTable, matches: Assignments, states: States
    ) -> tuple[States, Assignments]:
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

    def _note(self, t_ns: int, matches: Assignments) -> None:
        """Keep the states' names: tracked while seen well, coasting for a while without, then lost."""
        seen = np.zeros(len(self.robots), bool)
        seen[self.catalogue.robot[matches.disc]] = True
        self._seen, self._seen_ns[seen & self.owned] = seen, t_ns
        silent = (t_ns - self._seen_ns) * 1e-9 > self.limits.lost_after_s
        vague = self._is_vague()
        for k, status in enumerate(self.status):
            if not self.owned[k]:
                self.status[k] = "lost" if status is not None and silent[k] else status
            elif seen[k]:
                self.status[k] = "coasting" if vague[k] else "tracked"
            elif status in ("tracked", "coasting"):
                self.status[k] = "lost" if silent[k] else "coasting"
                if silent[k]:
                    self.states.v[k] = self.states.omega[k] = 0

    def _is_vague(self) -> Mask:
        """(N,) robots whose place is known worse than `tracked_sigma_m` along some direction."""
        place, most = self.states.P[:, POSITION, POSITION], self.limits.tracked_sigma_m**2
        vague = np.einsum("nii->n", place) > most  # or else no eigenvalue is
        vague[vague] = np.linalg.eigvalsh(place[vague])[:, -1] > most
        return vague

    def tell(self) -> ShardPoses:
        """For the other shards, after `advance`: where this one's robots are."""
        assert self._t_ns is not None
        known = np.array([status is not None for status in self.status], bool)
        return shard_poses_of(
            self.names, self._t_ns, self.states, self.status, np.flatnonzero(known & self.owned)
        )

    def follow(self, told: ShardPoses) -> None:
        """Another shard's robots are there: their detections are its own, and not for ours."""
        if len(self._others) < OTHERS:
            self._others.append(told)

    def _take_others(self) -> None:
        """The robots of other shards as these told of them, at this tracker's last instant."""
        told, self._others = self._others, []
        if self._t_ns is None:
            return
        for one in told:
            at = np.array([self._row.get(name, -1) for name in one.robots], np.intp)
            new = np.flatnonzero((at >= 0) & ~self.owned[at] & (one.t_ns > self._seen_ns[at]))
            self.states = self.states.with_rows(at[new], states_of(one, self._t_ns).select(new))
            self._seen_ns[at[new]] = one.t_ns
            for k in new.tolist():
                self.status[at[k]] = one.states[k]

    def adopt(self, rows: Index, states: States) -> None:
        """Robots that were found stand there from now on."""
        self.states = self.states.with_rows(rows, states)
        for k in rows:
            self.status[k] = "tracked"
