# SPDX-License-Identifier: BSD-3-Clause
"""Simulates omnidirectional robots on a floor, and what their cameras see of each other under changing light.

Commands become motions with lag, limits and slip. Planar poses (x, y, heading) are arrays (3,), metres and radians:
T_a_b is the pose of b in a. A robot's frame is that of its camera: x points where the camera looks, y to the left.
"""

import threading
import zlib
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from camera_node.foundation.arrays import Array, Grey
from camera_node.geometry.body import Body
from camera_node.geometry.pose import invert
from camera_node.simulation.discs import place_discs
from camera_node.simulation.floor import Picture
from camera_node.simulation.renderer import ImageModel
from camera_node.simulation.scene import SceneCamera

STEP_S = 0.005
HISTORY_S = 3.0
LAG_S = 0.1  # time constant of a drive
LIMITS = np.array([0.8, 0.8, 1.5])  # of a velocity: m/s, m/s, rad/s
SLIP_S = 1.0  # correlation time of slip
SLIP = np.array([0.01, 0.01, 0.02])  # standard deviation of velocities that odometry does not see
ODOMETRY_SCALE = 0.01  # standard deviation of the scale errors of odometry, constant for each robot
ODOMETRY_NOISE = np.array([0.005, 0.005, 0.01])  # standard deviation of a step's velocities in odometry
STANDSTILL = np.zeros(3)
FPS = 30.0
ROUNDEL = Body(diameter_m=0.14)  # the paper's
CAMERA_M, ROUNDEL_M = 0.20, 0.32  # heights above the floor
CAMERA = SceneCamera(
    width=480,
    height=360,
    fx=330.0,
    fy=330.0,
    cx=239.5,
    cy=179.5,
    distortion=(-0.11, 0.03, 0.0, 0.0, 0.0),
    position_m=(0.0, 0.0, CAMERA_M),
    look_at_m=(1.0, 0.0, CAMERA_M),
    fps=FPS,
)
LAMP_S = 20.0  # a lamp is switched on and off
DIMMEST, BRIGHTEST = 0.3, 1.1  # the light over that of a well-lit room


def compose(T_a_b: Array, T_b_c: Array) -> Array:
    """T_a_c (3,)."""
    c, s = np.cos(T_a_b[2]), np.sin(T_a_b[2])
    x, y, turn = T_b_c
    return np.array([T_a_b[0] + c * x - s * y, T_a_b[1] + s * x + c * y, wrap(T_a_b[2] + turn)])


def between(T_a_b: Array, T_a_c: Array) -> Array:
    """T_b_c (3,)."""
    c, s = np.cos(T_a_b[2]), np.sin(T_a_b[2])
    dx, dy = T_a_c[0] - T_a_b[0], T_a_c[1] - T_a_b[1]
    return np.array([c * dx + s * dy, c * dy - s * dx, wrap(T_a_c[2] - T_a_b[2])])


def moved(T: Array, twist: Array, dt_s: float) -> Array:
    """The pose after `dt_s` with a constant `twist` (3,): forward and left m/s, counter-clockwise rad/s."""
    step = twist * dt_s
    half = step[2] / 2
    chord = np.sinc(half / np.pi)  # of an arc of length 1 and angle 2 half
    c, s = chord * np.cos(half), chord * np.sin(half)
    return compose(T, np.array([c * step[0] - s * step[1], s * step[0] + c * step[1], step[2]]))


def wrap(angle: float) -> float:
    """The same angle in [-pi, pi)."""
    return float((angle + np.pi) % (2 * np.pi) - np.pi)


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


class RobotCamera:
    """The camera of one robot; it sees the roundels of the others.

    Args:
        world: the robots.
        name: the robot's.
        floor: from `paint_floor`.
    """

    def __init__(self, world: RobotWorld, name: str, floor: Picture) -> None:
        self._world, self._name, self._floor = world, name, floor
        self._model = ImageModel(CAMERA, zlib.crc32(name.encode()))

    def capture(self, t_s: float, frame: int) -> Grey:
        """The picture (h, w) of an exposure at `t_s`, which the world has reached; `frame` seeds its noise."""
        pose = self._world.at(self._name, t_s).pose
        T_cam_world = invert(camera_matrix(pose))
        image = self._model.view(self._floor, camera_matrix(pose), subsamples=1)
        others = [self._world.at(name, t_s).pose for name in self._world.names if name != self._name]
        discs = [
            disc for other in others for disc in place_discs(ROUNDEL, T_cam_world @ roundel_matrix(other))
        ]
        for disc in sorted(discs, key=lambda disc: -float(np.linalg.norm(disc.T[:3, 3]))):
            if disc.faces_camera:
                self._model.paint(image, [disc])
        return self._model.expose(image * np.float32(light(t_s, float(pose[2]))), frame)


def light(t_s: float, heading: float) -> float:
    """The light at a time, for a camera that looks in a direction: clouds, a lamp that is switched, and a window."""
    clouds = 0.5 + 0.25 * np.sin(2 * np.pi * t_s / 13)
    lamp = 0.3 if t_s % (2 * LAMP_S) < LAMP_S else 0.0
    window = 0.15 * np.cos(heading - 1.0)
    return float(np.clip(clouds + lamp + window, DIMMEST, BRIGHTEST))


def camera_matrix(pose: Array) -> Array:
    """T_world_cam (4, 4) of a robot's camera; it looks along the robot's x axis."""
    c, s = np.cos(pose[2]), np.sin(pose[2])
    T = np.eye(4)
    T[:3, :3] = [[s, 0, c], [-c, 0, s], [0, -1, 0]]
    T[:3, 3] = [*pose[:2], CAMERA_M]
    return T


def roundel_matrix(pose: Array) -> Array:
    """T_world_roundel (4, 4) of a robot's roundel; it faces along the robot's x axis."""
    c, s = np.cos(pose[2]), np.sin(pose[2])
    T = np.eye(4)
    T[:3, :3] = [[-s, 0, c], [c, 0, s], [0, 1, 0]]
    T[:3, 3] = [*pose[:2], ROUNDEL_M]
    return T
