# SPDX-License-Identifier: BSD-3-Clause
"""Simulates omnidirectional robots on a floor: commands become motions with lag, limits and slip.

A robot's frame is that of its camera: x points where the camera looks, y to the left.
"""

import threading
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from camera_node.foundation.arrays import Array
from web.formation.planar import moved, wrap

STEP_S = 0.005
HISTORY_S = 3.0
LAG_S = 0.1  # time constant of a drive
LIMITS = np.array([0.8, 0.8, 1.5])  # of a velocity: m/s, m/s, rad/s
SLIP_S = 1.0  # correlation time of slip
SLIP = np.array([0.01, 0.01, 0.02])  # standard deviation of velocities that odometry does not see
ODOMETRY_SCALE = 0.01  # standard deviation of the scale errors of odometry, constant for each robot
ODOMETRY_NOISE = np.array([0.005, 0.005, 0.01])  # standard deviation of a step's velocities in odometry
STANDSTILL = np.zeros(3)


@dataclass(frozen=True, slots=True)
class Moment:
    """A robot at one time: true pose in the world, and pose by its odometry since the start, (3,) each."""

    t_s: float
    pose: Array
    odometry: Array


class SimulatedRobot:
    """One robot; `RobotWorld` moves it.

    Args:
        pose: initial pose (3,).
        rng: of its slip and odometry.
    """

    def __init__(self, pose: Array, rng: np.random.Generator) -> None:
        self.command = STANDSTILL
        self.history: deque[Moment] = deque([Moment(0.0, pose, np.zeros(3))], round(HISTORY_S / STEP_S))
        self._rng = rng
        self._velocity, self._slip = np.zeros(3), np.zeros(3)
        self._scale = 1 + ODOMETRY_SCALE * rng.standard_normal(3)

    def step(self, t_s: float) -> None:
        """Move until `t_s`, which is `STEP_S` after the last time."""
        keep = np.exp(-STEP_S / SLIP_S)
        kick = np.sqrt(1 - keep**2) * SLIP
        self._slip = keep * self._slip + kick * self._rng.standard_normal(3)
        wanted = np.clip(self.command, -LIMITS, LIMITS)
        self._velocity = self._velocity + (wanted - self._velocity) * (STEP_S / LAG_S)
        is_moving = np.abs(self._velocity).max() > 1e-3
        measured = self._scale * self._velocity + is_moving * ODOMETRY_NOISE * self._rng.standard_normal(3)
        last = self.history[-1]
        pose = moved(last.pose, self._velocity + is_moving * self._slip, STEP_S)
        self.history.append(Moment(t_s, pose, moved(last.odometry, measured, STEP_S)))

    def at(self, t_s: float) -> Moment:
        """The robot at a time of the last `HISTORY_S`; earlier and later times are those of the first and last step."""
        latest = self.history[-1]
        steps = np.clip((latest.t_s - t_s) / STEP_S, 0, len(self.history) - 1)
        k, share = int(steps), steps - int(steps)
        after = self.history[-1 - k]
        before = self.history[max(-2 - k, -len(self.history))]
        return Moment(
            t_s, _mean(after.pose, before.pose, share), _mean(after.odometry, before.odometry, share)
        )


class RobotWorld:
    """All robots, from time 0 on; safe to use from several threads.

    Args:
        poses: initial pose (3,) of each robot.
        seed: of slip and odometry.
    """

    def __init__(self, poses: Mapping[str, Array], seed: int = 0) -> None:
        self._robots = {
            name: SimulatedRobot(np.array(pose, float), np.random.default_rng((seed, k)))
            for k, (name, pose) in enumerate(poses.items())
        }
        self._steps = 0
        self._lock = threading.Lock()

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(self._robots)

    def advance(self, t_s: float) -> None:
        """Move all robots until `t_s` by their commands; nothing happens if that has passed."""
        with self._lock:
            self._advance(t_s)

    def drive(self, name: str, command: Array, t_s: float) -> None:
        """Give a robot a command at `t_s`: velocity forward and to the left, m/s, and turn rate, rad/s."""
        with self._lock:
            self._advance(t_s)
            self._robots[name].command = command

    def at(self, name: str, t_s: float) -> Moment:
        """A robot at `t_s`, as in `SimulatedRobot.at`."""
        with self._lock:
            return self._robots[name].at(t_s)

    def _advance(self, t_s: float) -> None:
        while (self._steps + 1) * STEP_S <= t_s + 1e-9:
            self._steps += 1
            for robot in self._robots.values():
                robot.step(self._steps * STEP_S)


def _mean(a: Array, b: Array, share: float) -> Array:
    """The pose between a and b, with `share` of b."""
    change = np.array([*(b - a)[:2], wrap(b[2] - a[2])])
    return np.array([*(a + share * change)[:2], wrap(a[2] + share * change[2])])
