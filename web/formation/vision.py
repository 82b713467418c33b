# SPDX-License-Identifier: BSD-3-Clause
"""The camera and the roundel of a simulated robot: pictures of the other robots' roundels under changing light."""

import zlib

import numpy as np

from camera_node.foundation.arrays import Array, Grey
from camera_node.geometry.body import Body
from camera_node.geometry.pose import invert
from camera_node.simulation.discs import place_discs
from camera_node.simulation.floor import Picture, paint_floor
from camera_node.simulation.renderer import ImageModel
from camera_node.simulation.scene import SceneCamera
from web.formation.world import RobotWorld

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


def paint_background(seed: int = 0) -> Picture:
    """The cluttered floor of the arena."""
    return paint_floor(seed)


class RobotCamera:
    """The camera of one robot; it sees the roundels of the others.

    Args:
        world: the robots.
        name: the robot's.
        floor: from `paint_background`.
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
