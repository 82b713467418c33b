# SPDX-License-Identifier: BSD-3-Clause
"""How cameras, markers and robots look: batched Viser handles, because single ones cost 20 times as much."""

import math
from typing import Any

import numpy as np
import viser
from numpy.typing import ArrayLike, NDArray

from calib.rig.camera import Camera
from camera_node.geometry.pose import wxyz_from_rotation
from web.feed import FAR_M, Latest
from web.tables import robot_state
from web.trails import Trails, fade

BACKGROUND = (3, 3, 4)
CAMERA, GHOST, LABELLED, UNLABELLED = (122, 162, 247), (235, 238, 245), (255, 255, 255), (150, 150, 150)
PICKED = (255, 214, 64)
COASTING, LOST = (222, 99, 10), (40, 20, 20)
# Viser's meshes and lines take colours as linear light: (c / 255)^2.2 of what is to be seen.
ROBOTS = np.array(
    [[12, 150, 105], [238, 47, 70], [53, 119, 255], [255, 154, 38], [129, 84, 238], [89, 159, 37]], np.uint8
)
BODY_RADIUS_M, BODY_HEIGHT_M = 0.13, 0.03
LABEL_ABOVE = np.array([0.0, 0.0, 0.16])


def light(scene: viser.SceneApi) -> None:
    """One sun and a soft sky: Viser's own lights wash colours out on a dark ground."""
    scene.configure_default_lights(enabled=False)
    scene.configure_environment_map(None)
    scene.add_light_ambient("/lights/sky", intensity=1.2)
    scene.add_light_directional("/lights/sun", intensity=1.6, position=(2.0, -3.0, 5.0))


def draw_camera(scene: viser.SceneApi, name: str, camera: Camera) -> list[Any]:
    T = camera.matrix()
    frustum = scene.add_camera_frustum(
        f"/cameras/{name}",
        fov=2 * math.atan(camera.height / (2 * camera.fy)),
        aspect=camera.width * camera.fy / (camera.height * camera.fx),
        scale=0.2,
        thickness=0.01,
        color=CAMERA,
        variant="filled",
        wxyz=wxyz_from_rotation(T[:3, :3]),
        position=T[:3, 3],
    )
    above = T[:3, 3] + [0.0, 0.0, 0.12]
    label = scene.add_label(f"/names/cameras/{name}", name, position=above, anchor="bottom-center")
    return [frustum, label]


class MarkerCloud:
    """Every marker as one dot of one batched handle: white where it belongs to a robot, grey where to none."""

    def __init__(self, scene: viser.SceneApi) -> None:
        self._cloud = scene.add_point_cloud(
            "/markers",
            np.zeros((1, 3), np.float32),
            np.zeros((1, 3), np.uint8),
            point_size=0.035,
            point_shape="circle",
            precision="float32",
            visible=False,
        )

    def draw(self, latest: Latest) -> None:
        seen = latest.markers
        points = seen.message.positions() if seen is not None and latest.age(seen) < 0.5 else np.empty((0, 3))
        known = (np.abs(points) < FAR_M).all(axis=1)  # NaN is not
        self._cloud.visible = bool(known.any())
        if seen is not None and known.any():
            labelled = seen.message.robot_index()[known] >= 0
            self._cloud.points = points[known].astype(np.float32)
            self._cloud.colors = np.where(labelled[:, None], LABELLED, UNLABELLED).astype(np.uint8)


class RobotDrawing:
    """Axes, bodies and trails of all robots, one batched handle each; and one label a robot."""

    def __init__(self, scene: viser.SceneApi) -> None:
        self.scene = scene
        self.trails = Trails()
        self._names: list[str] = []
        self._axes: Any = None
        self._bodies: Any = None
        self._tails: Any = None
        self._labels: dict[str, Any] = {}

    def draw(self, latest: Latest, trails: bool) -> None:
        names = sorted(latest.poses)
        if not names:
            return
        poses = [latest.poses[name].message for name in names]
        positions = np.array([pose.position for pose in poses], np.float32)
        wxyzs = np.array([pose.quaternion_wxyz for pose in poses], np.float32)
        states = [robot_state(latest, name) for name in names]
        if names != self._names:
            self._recreate(names, positions, wxyzs)
        self._axes.batched_positions, self._axes.batched_wxyzs = positions, wxyzs
        self._bodies.batched_positions, self._bodies.batched_wxyzs = positions, wxyzs
        self._bodies.batched_colors = colour_robots(states)
        for name, position, state in zip(names, positions, states, strict=True):
            self._labels[name].position = position + LABEL_ABOVE
            self._labels[name].text = name if state == "tracked" else f"{name}: {state}"
        if trails:
            self._draw_trails(names, positions, states)

    def _draw_trails(self, names: list[str], positions: ArrayLike, states: list[str]) -> None:
        for name, position, state in zip(names, np.asarray(positions), states, strict=True):
            if state in ("tracked", "coasting"):
                self.trails.add(name, position)
        self._tails.points = self.trails.segments(names)

    def _recreate(self, names: list[str], positions: NDArray, wxyzs: NDArray) -> None:
        self._names = names
        for name, position in zip(names, positions, strict=True):
            if name not in self._labels:
                self._labels[name] = self.scene.add_label(
                    f"/names/robots/{name}", name, anchor="bottom-center"
                )
                self.trails.add(name, position)
        self._axes = self.scene.add_batched_axes(
            "/robots/axes", wxyzs, positions, axes_length=0.22, axes_radius=0.008
        )
        vertices, faces = puck(BODY_RADIUS_M, BODY_HEIGHT_M)
        self._bodies = self.scene.add_batched_meshes_simple(
            "/robots/bodies",
            vertices,
            faces,
            wxyzs,
            positions,
            batched_colors=_own_colours(len(names)),
            opacity=0.75,
        )
        colours = fade(_own_colours(len(names)), BACKGROUND)
        self._tails = self.scene.add_line_segments(
            "/robots/trails", self.trails.segments(names), colours, thickness=0.014
        )


def colour_robots(states: list[str]) -> NDArray[np.uint8]:
    """(R, 3) a robot's own colour while it is tracked; another one that says coasting, and one for lost or away."""
    colours = _own_colours(len(states))
    for row, state in zip(colours, states, strict=True):
        if state != "tracked":
            row[:] = COASTING if state == "coasting" else LOST
    return colours


def _own_colours(count: int) -> NDArray[np.uint8]:
    return ROBOTS[np.arange(count) % len(ROBOTS)]


def puck(radius: float, height: float, sides: int = 32) -> tuple[NDArray[np.float32], NDArray[np.uint32]]:
    """Vertices (V, 3) and faces (F, 3) of a flat cylinder whose top is the plane z = 0 of the body."""
    turn = np.linspace(0, 2 * np.pi, sides, endpoint=False)
    ring = np.column_stack([radius * np.cos(turn), radius * np.sin(turn), np.zeros(sides)])
    vertices = np.vstack([ring, ring - [0, 0, height], [[0, 0, 0], [0, 0, -height]]])
    a = np.arange(sides)
    b, top, bottom = (a + 1) % sides, np.full(sides, 2 * sides), np.full(sides, 2 * sides + 1)
    faces = np.vstack(
        [
            np.column_stack([top, a, b]),
            np.column_stack([bottom, b + sides, a + sides]),
            np.column_stack([a, a + sides, b]),
            np.column_stack([b, a + sides, b + sides]),
        ]
    )
    return vertices.astype(np.float32), faces.astype(np.uint32)
