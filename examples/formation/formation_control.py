# SPDX-License-Identifier: BSD-3-Clause
"""Estimates another robot's motion from relative positions, and controls a leader and its followers by it.

The estimator is an extended Kalman filter. Its state is the pose (x, y, heading) of the other robot in this one's frame
and its velocity in its own frame. This robot's motion between two frames comes from its odometry.

The leader drives backwards: its camera and its roundel face the followers. A follower holds a place in the leader's
frame and looks at it, so that it sees the leader's roundel at an angle, from which it knows the leader's heading.
"""

from dataclasses import dataclass
from itertools import product
from typing import Protocol

import numpy as np

from camera_node.detection.roundels import LocatedRoundels
from camera_node.foundation.arrays import Array
from formation.formation_robots import STANDSTILL, between, moved, wrap

DISTANCE_M = 1.2  # of a follower from the leader
ANGLE = np.radians(25.0)  # of a follower from the leader's camera axis
GAIN = 2.5  # 1/s, of the control of positions and heading
BLIND_S = 0.5  # without a sighting, after which a robot stops
START_SIGMA = np.array([0.3, 0.3, 0.3])
SPEED, TURN = 0.18, 0.22  # of the leader, m/s and rad/s
SWING_S, PULSE_S = 26.0, 17.0  # periods of its turns and of its speed
SLOW_M, STOP_M = 0.08, 0.25  # errors of a follower at which the leader slows down and stops
SLOWER, FASTER = 2.0, 0.4  # 1/s, change of the leader's share of its speed
ACCELERATION = np.array([0.4, 0.4, 0.6])  # of the other robot, as noise: m/s^2 and rad/s^2 per root hertz
SLIP = np.array([0.01, 0.01, 0.02])  # of this robot, as noise: m/s and rad/s per root hertz
POSITION_SIGMA_M, HEADING_SIGMA = 1e-3, 5e-3  # of lens, diameter and mounting; added to the claimed ones
INITIAL_VELOCITY = np.array([0.3, 0.3, 0.3])  # standard deviations
GATE = 25.0  # squared Mahalanobis distance, three degrees of freedom
NUMERIC = 1e-6


@dataclass(frozen=True, slots=True)
class PlanarSighting:
    """A roundel seen by a robot, with one of both normals: T_robot_other (3,), covariance (3, 3), probability."""

    pose: Array
    cov: Array
    probability: float


def sightings(seen: LocatedRoundels) -> list[PlanarSighting]:
    """All roundels with both normals, projected to the floor. The camera's z is the robot's x, its x the robot's -y."""
    result = []
    for row, k in product(range(len(seen)), range(2)):
        (right, _, ahead), normal = seen.position[row], seen.normals[row, k]
        cov = np.zeros((3, 3))
        to_plane = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0]])
        cov[:2, :2] = to_plane @ seen.cov[row] @ to_plane.T + POSITION_SIGMA_M**2 * np.eye(2)
        cov[2, 2] = seen.normal_sigma[row, k] ** 2 + HEADING_SIGMA**2
        pose = np.array([ahead, -right, np.arctan2(-normal[0], normal[2])])
        result.append(PlanarSighting(pose, cov, float(seen.probability[row, k])))
    return result


class RelativeEstimator:
    """Follows one other robot.

    Args:
        expected: its pose (3,) in this robot's frame at the start.
        sigma: standard deviations (3,) of that.

    Attributes:
        updated_s: the time of the last sighting; None before the first.
    """

    def __init__(self, expected: Array, sigma: Array) -> None:
        self._state = np.array([*expected, 0.0, 0.0, 0.0])
        self._cov = np.diag(np.array([*sigma, *INITIAL_VELOCITY]) ** 2)
        self._t_s: float | None = None
        self._odometry = np.zeros(3)
        self.updated_s: float | None = None

    def update(self, seen: LocatedRoundels, t_s: float, odometry: Array) -> None:
        """Take the roundels of a frame at `t_s`, when this robot's odometry was `odometry` (3,)."""
        if self._t_s is not None and t_s <= self._t_s:
            return
        self._state, self._cov = self._predict(t_s, odometry)
        self._t_s, self._odometry = t_s, odometry
        costs = [(self._cost(sighting), sighting) for sighting in sightings(seen)]
        cost, best = min(costs, key=lambda pair: pair[0], default=(np.inf, None))
        if best is not None and cost < GATE:
            self._correct(best)
            self.updated_s = t_s

    def predicted(self, t_s: float, odometry: Array) -> tuple[Array, Array]:
        """Pose (3,) and velocity (3,) of the other robot at `t_s`, when this robot's odometry is `odometry`."""
        state = self._predict(t_s, odometry)[0]
        return state[:3], state[3:]

    def _predict(self, t_s: float, odometry: Array) -> tuple[Array, Array]:
        if self._t_s is None:
            return self._state, self._cov
        dt_s = max(0.0, t_s - self._t_s)
        own = between(self._odometry, odometry)

        def transition(state: Array) -> Array:
            pose = moved(state[:3], state[3:], dt_s)
            return np.array([*between(own, pose), *state[3:]])

        state = transition(self._state)
        F = np.empty((6, 6))
        for k in range(6):
            step = np.zeros(6)
            step[k] = NUMERIC
            change = transition(self._state + step) - state
            change[2] = wrap(change[2])
            F[:, k] = change / NUMERIC
        noise = np.array([*SLIP, *ACCELERATION]) ** 2 * dt_s
        return state, F @ self._cov @ F.T + np.diag(noise)

    def _cost(self, sighting: PlanarSighting) -> float:
        """Squared Mahalanobis distance of a sighting, plus -2 log of the probability of its normal."""
        e = self._innovation(sighting)
        distance = float(e @ np.linalg.solve(self._cov[:3, :3] + sighting.cov, e))
        return distance - 2 * np.log(max(sighting.probability, 1e-9))

    def _innovation(self, sighting: PlanarSighting) -> Array:
        e = sighting.pose - self._state[:3]
        return np.array([e[0], e[1], wrap(e[2])])

    def _correct(self, sighting: PlanarSighting) -> None:
        gain = np.linalg.solve(self._cov[:3, :3] + sighting.cov, self._cov[:3, :]).T
        state = self._state + gain @ self._innovation(sighting)
        state[2] = wrap(state[2])
        keep = np.eye(6)
        keep[:, :3] -= gain
        self._state, self._cov = state, keep @ self._cov @ keep.T + gain @ sighting.cov @ gain.T


def is_recent(estimator: RelativeEstimator, t_s: float) -> bool:
    """Whether the robot was seen lately."""
    return estimator.updated_s is not None and t_s - estimator.updated_s < BLIND_S


class Controller(Protocol):
    """One robot's control. Times are seconds, and odometry (3,) is the robot's own pose since its start."""

    def see(self, seen: LocatedRoundels, t_s: float, odometry: Array) -> None:
        """Take the roundels of a frame that was captured at `t_s`."""
        ...

    def command(self, t_s: float, odometry: Array) -> Array:
        """The velocity (3,) from `t_s` on: forward and to the left, m/s, and turn rate, rad/s."""
        ...


def place_of(side: int) -> Array:
    """Pose (3,) of a follower in the leader's frame: 1 is the left `side` of the leader's camera, -1 the right one."""
    angle = side * ANGLE
    return np.array([DISTANCE_M * np.cos(angle), DISTANCE_M * np.sin(angle), wrap(angle + np.pi)])


class Follower:
    """Holds its place: the leader's velocity as feedforward, and proportional feedback of the relative pose."""

    def __init__(self, side: int) -> None:
        self.wanted = between(place_of(side), np.zeros(3))  # T_follower_leader
        self._leader = RelativeEstimator(self.wanted, START_SIGMA)

    def see(self, seen: LocatedRoundels, t_s: float, odometry: Array) -> None:
        self._leader.update(seen, t_s, odometry)

    def command(self, t_s: float, odometry: Array) -> Array:
        if not is_recent(self._leader, t_s):
            return STANDSTILL
        (x, y, heading), velocity = self._leader.predicted(t_s, odometry)
        turn = velocity[2] + GAIN * wrap(heading - self.wanted[2])
        c, s = np.cos(heading), np.sin(heading)
        ahead = c * velocity[0] - s * velocity[1] + turn * y + GAIN * (x - self.wanted[0])
        left = s * velocity[0] + c * velocity[1] - turn * x + GAIN * (y - self.wanted[1])
        return np.array([ahead, left, turn])


class Leader:
    """Drives a course, and waits for followers that it sees out of place or not at all."""

    def __init__(self) -> None:
        self._followers = {side: RelativeEstimator(place_of(side), START_SIGMA) for side in (1, -1)}
        self._share, self._course_s, self._last_s = 0.0, 0.0, 0.0

    def see(self, seen: LocatedRoundels, t_s: float, odometry: Array) -> None:
        for follower in self._followers.values():
            follower.update(seen, t_s, odometry)

    def command(self, t_s: float, odometry: Array) -> Array:
        dt_s, self._last_s = max(0.0, t_s - self._last_s), t_s
        wanted = min(self._readiness(side, t_s, odometry) for side in self._followers)
        self._share += float(np.clip(wanted - self._share, -SLOWER * dt_s, FASTER * dt_s))
        self._course_s += self._share * dt_s
        speed = SPEED * (1 + 0.3 * np.sin(2 * np.pi * self._course_s / PULSE_S))
        turn = TURN * np.sin(2 * np.pi * self._course_s / SWING_S)
        return self._share * np.array([-speed, 0.0, turn])

    def _readiness(self, side: int, t_s: float, odometry: Array) -> float:
        """1 if a follower is in its place, 0 if it is far from it or was not seen lately."""
        follower = self._followers[side]
        if not is_recent(follower, t_s):
            return 0.0
        error = np.linalg.norm(follower.predicted(t_s, odometry)[0][:2] - place_of(side)[:2])
        return float(np.clip((STOP_M - error) / (STOP_M - SLOW_M), 0.0, 1.0))
