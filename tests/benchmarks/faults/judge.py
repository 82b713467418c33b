# SPDX-License-Identifier: BSD-3-Clause
"""Compares received poses with the truth, and finds the gaps between them."""

import threading
from dataclasses import dataclass, field

import numpy as np

from fusion.model.states import POSITION
from fusion.protocol.pose_messages import RobotPose
from tests.benchmarks.faults.world import Clock, World

MAX_ERROR_M = 0.010  # a tracked pose is wrong if its error is above this and above MAX_SIGMAS
MAX_SIGMAS = 5.0
LONGEST = 100_000  # gaps and wrong poses that are kept


@dataclass(frozen=True)
class Gap:
    """No tracked pose of a visible robot between two moments of the monotonic clock, s."""

    robot: str
    from_s: float
    until_s: float

    @property
    def seconds(self) -> float:
        return self.until_s - self.from_s


@dataclass(frozen=True)
class WrongPose:
    """A tracked pose that is further from the truth than allowed, and the cameras that contributed to it."""

    robot: str
    received_s: float
    error_m: float
    sigmas: float
    cameras: tuple[str, ...] = ()

    def __str__(self) -> str:
        return f"{1e3 * self.error_m:.1f} mm, {self.sigmas:.1f} sigma, from {' '.join(self.cameras) or 'no camera'}"


@dataclass
class PoseJudge:
    """Takes the poses of all robots as they arrive, on any thread.

    Attributes:
        min_gap_s: gaps that are longer are kept.
        max_error_m: smaller errors are right.
        clock: by which poses arrive.
        count, rms_m, largest_m: of tracked poses: their number, and their errors.
        largest_by_cameras_m: the largest error of the poses to which exactly these cameras contributed.
    """

    world: World
    min_gap_s: float = 0.1
    max_error_m: float = MAX_ERROR_M
    gaps: list[Gap] = field(default_factory=list)
    wrong: list[WrongPose] = field(default_factory=list)
    clock: Clock = field(default_factory=Clock)
    count: int = 0
    squared_m2: float = 0.0
    largest_m: float = 0.0
    largest_by_cameras_m: dict[tuple[str, ...], float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self._last_s: dict[str, float] = {}
        self._lock = threading.Lock()
        self._truth_ns, self._truth = -1, self.world.states(self.world.epoch_ns).p

    def receive(self, pose: RobotPose) -> None:
        """Judge a pose."""
        if pose.state != "tracked" or pose.robot not in self.world.names:
            return
        with self._lock:
            now_s = self.clock.now_s()
            self._close_gap(pose.robot, now_s)
            self._last_s[pose.robot] = now_s
            self._compare(pose, now_s)

    def tracked(self, within_s: float) -> int:
        """How many robots had a tracked pose within the last seconds."""
        now_s = self.clock.now_s()
        return sum(now_s - at_s < within_s for at_s in tuple(self._last_s.values()))

    def forget(self) -> None:
        """Begin again: no robot was tracked so far, and nothing was seen."""
        with self._lock:
            self._last_s.clear()
            self.gaps.clear()
            self.wrong.clear()
            self.count, self.squared_m2, self.largest_m = 0, 0.0, 0.0
            self.largest_by_cameras_m.clear()

    @property
    def rms_m(self) -> float:
        """Of the errors of tracked poses."""
        return float(np.sqrt(self.squared_m2 / max(1, self.count)))

    def close_gaps(self) -> None:
        """At the end: gaps of robots that did not come back."""
        with self._lock:
            for robot in self.world.names:
                self._close_gap(robot, self.clock.now_s())

    def _close_gap(self, robot: str, now_s: float) -> None:
        begun_s = self._last_s.get(robot)
        if begun_s is None or now_s - begun_s <= self.min_gap_s:
            return
        begun_s = max(begun_s, self._visible_since_s(robot, now_s))
        if now_s - begun_s > self.min_gap_s and len(self.gaps) < LONGEST:
            self.gaps.append(Gap(robot, begun_s, now_s))

    def _visible_since_s(self, robot: str, now_s: float) -> float:
        """When the robot was last uncovered, by the monotonic clock."""
        event = self.world.events.get(robot)
        return now_s + (event.hidden_until_ns - self.clock.now_ns()) * 1e-9 if event else 0.0

    def _compare(self, pose: RobotPose, now_s: float) -> None:
        if pose.t_ns != self._truth_ns:
            self._truth_ns, self._truth = pose.t_ns, self.world.states(pose.t_ns).p
        error = pose.position - self._truth[self.world.names.index(pose.robot)]
        error_m = float(np.linalg.norm(error))
        self.count += 1
        self.squared_m2 += error_m**2
        self.largest_m = max(self.largest_m, error_m)
        largest, cameras = self.largest_by_cameras_m, tuple(sorted(pose.cameras))
        largest[cameras] = max(largest.get(cameras, 0.0), error_m)
        if error_m <= self.max_error_m:
            return
        covariance = pose.covariance_matrix[POSITION, POSITION]
        is_claim = np.linalg.eigvalsh(covariance)[0] > 0
        sigmas = float(np.sqrt(error @ np.linalg.solve(covariance, error))) if is_claim else np.inf
        if sigmas > MAX_SIGMAS and len(self.wrong) < LONGEST:
            self.wrong.append(WrongPose(pose.robot, now_s, error_m, sigmas, cameras))
