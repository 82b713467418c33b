# SPDX-License-Identifier: BSD-3-Clause
"""Identifies constellations: accepts a fit that explains more markers, or fits clearly better, than every rival.

Rivals are fits of one robot, and fits with a common marker. Free-running cameras see a moving marker at different
positions, which makes its distances uncertain; so the detections decide, with an estimated velocity.

In a crowd, detections of two markers make a third one, and a false fit may use it. Such a fit is poorer than those of
other robots. So may be the fit of a robot whose markers are not quite as declared: a poor fit is accepted if all
markers are seen and no good fit contradicts it, in several frame sets.

Three markers of a larger robot are weak evidence: somewhere three of different robots have the distances of a robot
whose own markers are covered. So are three markers with fewer than `STRONG_DETECTIONS`, and three of which most frames
see one only: they face one way, so that a camera that sees one of them sees all. Such a fit is accepted at once where
the robot was last; elsewhere it must win in several frame sets too.

A robot with markers on several sides has so many distances that three or four markers fit some of them by chance. Such
a fit is refused unless the cameras detect most of the other markers that they should see, and weak unless they detect
almost all of them.

All limits delay: what one frame set leaves undecided, the next ones decide. The robots take turns.

Weak fits are confirmed in several frame sets. Markers of another body fit a constellation by an invented velocity of
about 1 m/s, which moves them by the centimetres that they are off between the exposures of free-running cameras. Such
fits stay where they are although they have a velocity.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.special import chdtri

from camera_node.foundation.arrays import Array, Index, Mask
from fusion.model.observations import Assignments, MatchedObservations
from fusion.model.robots import Robot
from fusion.model.states import VELOCITY, States
from fusion.tracking.constellation_search import (
    MIN_MARKERS,
    Candidates,
    Fits,
    Mappings,
    TriangulatedMarkers,
    fit,
)
from fusion.tracking.gating import DECISIVE_CHI2, MAX_CHI2, MOTION_GATE, POSE_DEGREES, POSITION_GATE

POOR = 10.0  # times the usual squared residual, above which a fit is poor
STRONG_DETECTIONS = 8  # of three markers: they overdetermine a pose by ten
# Shares of the expected views that are detected. A true fit has 1 where nothing covers the robot, one with a wrong
# marker up to 0.67, and a false one up to 0.5.
MIN_EXPLAINED, EVIDENT = 0.6, 0.8
CHANCE = 1e-3  # probability of a chi-square that is not chance
MAX_COMPARED = 1_000  # mappings in one frame set, all rivals of some robots; more wait for their turn
MAX_RIVALS = (
    3_000  # mappings that compete with those of one robot; with more it waits until others are acquired
)


@dataclass(frozen=True, slots=True, eq=False)
class RefinedFits:
    """K fits after an update with their detections.

    Attributes:
        robot: (K,) rows.
        states: with velocities.
        chi2: (K,) of the detections, of the position relative to the last one, and of the motion.
        motion: (K,) chi-square of the velocities with six degrees of freedom, before any detection.
        misfit: (K,) mean squared residual of a detection in standard deviations.
        is_expected: (K,) fits where the robot was last, or starts.
        explained: (K,) shares of the expected views that are detected, of robots with markers on several sides; NaN
            for others.
        shared: (K,) shares of their markers that a frame detects on average, of the frames that detect one of them.
        assignments, body: detections, and the fit of each.
        observations, equations, weights: of the assignments, row by row, as of `BodyFit`.
    """

    robot: Index
    states: States
    chi2: Array
    motion: Array
    misfit: Array
    is_expected: Mask
    explained: Array
    shared: Array
    assignments: Assignments
    body: Index
    observations: MatchedObservations
    equations: Array
    weights: Array

    def __len__(self) -> int:
        return len(self.robot)

    def select(self, rows: Mask) -> "RefinedFits":
        """The rows of a mask."""
        used = rows[self.body]
        body = (np.cumsum(rows) - 1)[self.body[used]]
        return RefinedFits(
            self.robot[rows],
            self.states.select(rows),
            self.chi2[rows],
            self.motion[rows],
            self.misfit[rows],
            self.is_expected[rows],
            self.explained[rows],
            self.shared[rows],
            self.assignments.select(used),
            body,
            self.observations.select(used).with_bodies(body),
            self.equations[used],
            self.weights[used],
        )


Refine = Callable[[Fits], RefinedFits]


@dataclass(frozen=True, slots=True, eq=False)
class Identified:
    """The accepted fits, the robots (rows) with plausible fits that were not accepted, and where to go on.

    Attributes:
        fits: one entry for each number of markers.
        weak: the same of poor fits and of weak ones, which the caller should confirm in several frame sets.
        rivals: by robot, the robot of the best rival; the robot itself where it fits in several places.
        unexplained: robots with fits whose expected views are mostly not detected.
        turn: row of the first robot whose turn it is in the next frame set.
    """

    fits: list[RefinedFits]
    weak: list[RefinedFits]
    rivals: dict[int, int]
    unexplained: set[int]
    turn: int


class _InUse:
    """Robots and points of fits."""

    def __init__(self, n_robots: int, n_points: int) -> None:
        self._robots, self._points = np.zeros(n_robots, bool), np.zeros(n_points, bool)

    def add(self, mappings: Mappings) -> None:
        self._robots[mappings.robot] = True
        self._points[mappings.points] = True

    def touch(self, mappings: Mappings) -> Mask:
        """(K,) mappings of a claimed robot or to a claimed point."""
        return self._robots[mappings.robot] | self._points[mappings.points].any(1)


@dataclass(frozen=True, slots=True, eq=False)
class _ComparedFits:
    """K fits with one number of markers, refined; chi-square and robot (K,) of the best rival of each."""

    fits: Fits
    refined: RefinedFits
    best: Array
    rival: Index

    @property
    def wins(self) -> Mask:
        """(K,) fits that are clearly better than all rivals."""
        return self.refined.chi2 + DECISIVE_CHI2 <= self.best

    def select(self, rows: Mask) -> "_ComparedFits":
        return _ComparedFits(
            self.fits.select(rows), self.refined.select(rows), self.best[rows], self.rival[rows]
        )


def identify(question: "MissingConstellations", refine: Refine, usual: float, turn: int) -> Identified:
    """Accept fits, those with most markers first.

    Args:
        question: which robots, and among which markers.
        refine: updates fits with their detections.
        usual: mean squared residual of tracked robots in standard deviations; 0 if none was tracked so far.
        turn: row of the first robot to decide about, where the limit allows only some.
    """
    robots = question.robots
    decisions = _Decisions(question, usual, turn)
    most = max((len(robot.markers) for robot in robots.values()), default=0)
    for count in range(most, MIN_MARKERS - 1, -1):
        decisions.decide(count, refine)
    decisions.decide_poor()
    return Identified(decisions.fits, decisions.weak, decisions.rivals, decisions.unexplained, decisions.turn)


@dataclass(frozen=True, slots=True, eq=False)
class MissingConstellations:
    """Missing constellations by row, the unassigned markers, and what the search found for these."""

    robots: dict[int, Robot]
    scene: TriangulatedMarkers
    candidates: Candidates


class _Decisions:
    """The decisions about the fits of a frame set, from those with most markers to those with fewest."""

    def __init__(self, question: MissingConstellations, usual: float, turn: int) -> None:
        size = max(question.robots, default=-1) + 1, len(question.scene)
        self._question, self._usual, self._is_usual_known = question, usual, usual > 0
        self._accepted, self._open, self._open_good = _InUse(*size), _InUse(*size), _InUse(*size)
        self._poor: list[_ComparedFits] = []
        self.fits: list[RefinedFits] = []
        self.weak: list[RefinedFits] = []
        self.rivals: dict[int, int] = {}
        self.unexplained: set[int] = set()
        self.turn = turn

    def decide(self, count: int, refine: Refine) -> None:
        """Decide about the good fits with `count` markers."""
        mappings = self._question.candidates.with_markers(count)
        mappings = mappings.select(~self._accepted.touch(mappings))
        compared, decided, self.turn = _portion(mappings, self.turn)
        self._open.add(mappings.select(~compared))
        level = self._compare(mappings.select(compared), refine)
        if level.wins.any() and not self._is_usual_known:
            self._usual = max(self._usual, float(np.median(level.refined.misfit[level.wins])))
        is_good = level.refined.misfit <= POOR * self._usual
        is_free = ~self._open.touch(level.fits.mappings) & np.isin(level.refined.robot, decided)
        self._accept(level, is_good & is_free & level.wins)
        rest = level.select(~self._accepted.touch(level.fits.mappings))
        self._open.add(rest.fits.mappings)
        is_good = rest.refined.misfit <= POOR * self._usual
        self._open_good.add(rest.fits.mappings.select(is_good))
        self._poor.append(rest.select(~is_good))

    def decide_poor(self) -> None:
        """Decide about the poor fits, each with all markers of its robot."""
        for level in self._poor:
            mappings = level.fits.mappings
            is_free = ~self._open_good.touch(mappings) & ~self._accepted.touch(mappings)
            self.weak.append(level.refined.select(self._has_all(mappings) & is_free & level.wins))

    def _compare(self, mappings: Mappings, refine: Refine) -> _ComparedFits:
        """Refine mappings and compare those that the detections allow."""
        fits = fit(mappings, self._question.robots, self._question.scene)
        refined = refine(fits)
        is_plausible = (refined.misfit < MAX_CHI2) & (refined.motion < MOTION_GATE)
        is_refused = refined.explained < MIN_EXPLAINED
        self.unexplained.update(refined.robot[is_plausible & is_refused].tolist())
        is_plausible &= ~is_refused
        fits, refined = fits.select(is_plausible), refined.select(is_plausible)
        return _ComparedFits(fits, refined, *_best_rivals(fits.mappings, refined.chi2))

    def _is_evident(self, level: _ComparedFits) -> Mask:
        """(K,) fits with more than three markers, or with all three of a robot and enough detections in common frames,
        whose chi-square is chance.

        Of a robot with several sides, those whose expected views are detected.
        """
        mappings = level.fits.mappings
        n_detections = np.bincount(level.refined.body, minlength=len(mappings))
        is_whole = self._has_all(mappings) & (n_detections >= STRONG_DETECTIONS)
        is_whole &= level.refined.shared >= MIN_EXPLAINED
        explained = level.refined.explained
        many = is_whole | (mappings.points.shape[1] > MIN_MARKERS)
        is_chance = level.refined.chi2 < chdtri(2 * n_detections - POSE_DEGREES, CHANCE)
        return is_chance & np.where(np.isnan(explained), many, explained >= EVIDENT)

    def _has_all(self, mappings: Mappings) -> Mask:
        """(K,) mappings of all markers of a robot."""
        sizes = [len(self._question.robots[k].markers) for k in mappings.robot.tolist()]
        return np.array(sizes, np.intp) == mappings.points.shape[1]

    def _accept(self, level: _ComparedFits, rows: Mask) -> None:
        self._accepted.add(level.fits.mappings.select(rows))
        is_strong = level.refined.is_expected | self._is_evident(level)
        self.fits.append(level.refined.select(rows & is_strong))
        self.weak.append(level.refined.select(rows & ~is_strong))
        is_close = np.abs(level.refined.chi2 - level.best) < DECISIVE_CHI2
        for k in np.flatnonzero(is_close).tolist():
            self.rivals.setdefault(int(level.refined.robot[k]), int(level.rival[k]))


def _portion(mappings: Mappings, turn: int) -> tuple[Mask, Index, int]:
    """(K,) mappings to compare, the robots all of whose rivals are among them, and whose turn is next."""
    robots = np.unique(mappings.robot)
    if len(mappings) <= MAX_COMPARED:
        return np.ones(len(mappings), bool), robots, turn
    compared, decided = np.zeros(len(mappings), bool), []
    for robot in np.roll(robots, -int(np.searchsorted(robots, turn))).tolist():
        claim = _InUse(int(robots.max()) + 1, int(mappings.points.max()) + 1)
        claim.add(mappings.select(mappings.robot == robot))
        rivals = claim.touch(mappings)
        if rivals.sum() > MAX_RIVALS:
            continue
        if decided and (compared | rivals).sum() > MAX_COMPARED:
            return compared, np.array(decided), robot
        compared |= rivals
        decided.append(robot)
    return compared, np.array(decided, np.intp), turn


def _best_rivals(mappings: Mappings, chi2: Array) -> tuple[Array, Index]:
    """(K,) smallest chi-square of the rivals of each mapping, infinite without any, and that rival's robot."""
    if not len(mappings):
        return chi2, mappings.robot
    uses = np.zeros((len(mappings), int(mappings.points.max()) + 1), np.float32)
    np.put_along_axis(uses, mappings.points, 1, 1)
    exclusive = (mappings.robot[:, None] == mappings.robot) | (uses @ uses.T > 0)
    np.fill_diagonal(exclusive, False)
    others = np.where(exclusive, chi2, np.inf)
    rival = others.argmin(1)
    return others[np.arange(len(chi2)), rival], mappings.robot[rival]


CONFIRMATIONS = 5  # frame sets in which a weak fit must be at one place
MAX_BETWEEN = 5  # frame sets from one to the next of these
SAME_PLACE_M = 0.15  # of a robot in two successive frame sets
SLACK_M_S = 0.15  # of a velocity, beyond its covariance


@dataclass(frozen=True, slots=True, eq=False)
class _Sighting:
    """The last weak fit of a robot.

    Attributes:
        p: (3,) its position.
        t_ns, frame_set: when it was.
        count: how many were at one place so far.
        drift: (3,) how far these moved, less what their velocities say.
        since_ns: the time of the first of these.
        cov_v: (3, 3) covariance of the last velocity; the same cameras make the same error in each frame set.
    """

    p: Array
    t_ns: int
    frame_set: int
    count: int
    drift: Array
    since_ns: int
    cov_v: Array

    @classmethod
    def of(cls, fit: States, t_ns: int, frame_set: int, last: "_Sighting | None") -> "_Sighting":
        """The sighting of one fit, after the last one."""
        p, v, cov_v = fit.p[0], fit.v[0], fit.P[0, VELOCITY, VELOCITY]
        first = cls(p, t_ns, frame_set, 1, np.zeros(3), t_ns, cov_v)
        if last is None:
            return first
        moved = p - last.p
        if np.linalg.norm(moved) > SAME_PLACE_M * max(1, frame_set - last.frame_set):
            return first
        drift = last.drift + moved - (t_ns - last.t_ns) * 1e-9 * v
        return cls(p, t_ns, frame_set, last.count + 1, drift, last.since_ns, cov_v)

    @property
    def is_confirmed(self) -> bool:
        """Whether enough fits were at one place, and moved as their velocities say."""
        if self.count < CONFIRMATIONS or self.t_ns <= self.since_ns:
            return False
        off = self.drift / ((self.t_ns - self.since_ns) * 1e-9)
        return bool(off @ np.linalg.solve(self.cov_v + SLACK_M_S**2 * np.eye(3), off) < POSITION_GATE)


class WeakFits:
    """The last weak fit of each robot."""

    def __init__(self) -> None:
        self._last: dict[int, _Sighting] = {}

    def confirm(self, weak: list[RefinedFits], t_ns: int, frame_set: int) -> list[RefinedFits]:
        """Of the weak fits of a frame set, those that were at one place in `CONFIRMATIONS`, and nowhere else between.

        Args:
            weak: at most one of each robot.
            t_ns: time of the frame set.
            frame_set: its number.
        """
        self._last = {k: seen for k, seen in self._last.items() if frame_set - seen.frame_set <= MAX_BETWEEN}
        for fits in weak:
            for k, robot in enumerate(fits.robot.tolist()):
                state, last = fits.states.select(np.array([k])), self._last.get(robot)
                self._last[robot] = _Sighting.of(state, t_ns, frame_set, last)
        return [
            fits.select(np.array([self._last[k].is_confirmed for k in fits.robot.tolist()], bool))
            for fits in weak
        ]
