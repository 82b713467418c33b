# SPDX-License-Identifier: BSD-3-Clause
"""Controls a leader and its followers by what their own cameras locate.

The leader drives backwards: its camera and its roundel face the followers. A follower holds a place in the leader's
frame and looks at it, so that it sees the leader's roundel at an angle, from which it knows the leader's heading.
"""

from typing import Protocol

import numpy as np

from camera_node.detection.roundels import LocatedRoundels
from camera_node.foundation.arrays import Array
from web.formation.estimator import RelativeEstimator
from web.formation.planar import between, wrap
from web.formation.world import STANDSTILL

DISTANCE_M = 1.2  # of a follower from the leader
ANGLE = np.radians(25.0)  # of a follower from the leader's camera axis
GAIN = 2.5  # 1/s, of the control of positions and heading
BLIND_S = 0.5  # without a sighting, after which a robot stops
START_SIGMA = np.array([0.3, 0.3, 0.3])
SPEED, TURN = 0.18, 0.22  # of the leader, m/s and rad/s
SWING_S, PULSE_S = 26.0, 17.0  # periods of its turns and of its speed
SLOW_M, STOP_M = 0.08, 0.25  # errors of a follower at which the leader slows down and stops
SLOWER, FASTER = 2.0, 0.4  # 1/s, change of the leader's share of its speed


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


def is_recent(estimator: RelativeEstimator, t_s: float) -> bool:
    """Whether the robot was seen lately."""
    return estimator.updated_s is not None and t_s - estimator.updated_s < BLIND_S
