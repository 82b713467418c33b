# SPDX-License-Identifier: BSD-3-Clause
"""Draws cameras, markers and robots with batched Viser handles, which cost 1/20 of single ones."""

import math
from typing import Any

import numpy as np
import viser
from numpy.typing import ArrayLike, NDArray

from calib.rig.camera import Camera
from camera_node.geometry.pose import wxyz_from_rotation
from web.feed import ArenaState
from web.tables import robot_state
from web.trails import Trails, fade

MARKERS_S = 0.5  # markers disappear after so long without a message
TRUE_POINTS_S = 1.0  # true positions disappear after so long without a message
BACKGROUND = (3, 3, 4)
CAMERA, LABELED, UNLABELED = (122, 162, 247), (255, 255, 255), (150, 150, 150)
TRUE_POINT, SELECTED = (235, 238, 245), (255, 214, 64)
COASTING, LOST = (222, 99, 10), (40, 20, 20)
# Viser's meshes and lines take linear light: (c / 255)^2.2 of the displayed colour.
ROBOTS = np.array(
    [[12, 150, 105], [238, 47, 70], [53, 119, 255], [255, 154, 38], [129, 84, 238], [89, 159, 37]], np.uint8
)
BODY_RADIUS_M, BODY_HEIGHT_M = 0.13, 0.03
LABEL_OFFSET_M = np.array([0.0, 0.0, 0.16])
CAMERA_LABEL_OFFSET_M = np.array([0.0, 0.0, 0.12])


def add_lights(scene: viser.SceneApi) -> None:
    """Add a sun and ambient light; Viser's default lights wash out colours on a dark ground."""
    scene.configure_default_lights(enabled=False)
    scene.configure_environment_map(None)
    scene.add_light_ambient("/lights/sky", intensity=1.2)
    scene.add_light_directional("/lights/sun", intensity=1.6, position=(2.0, -3.0, 5.0))


def draw_camera(scene: viser.SceneApi, name: str, camera: Camera) -> list[Any]:
    """Draw a calibrated camera as a frustum with its name; return the handles."""
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
    position = T[:3, 3] + CAMERA_LABEL_OFFSET_M
    label = scene.add_label(f"/names/cameras/{name}", name, position=position, anchor="bottom-center")
    return [frustum, label]


class MarkerCloud:
    """All markers as one point cloud: white if a robot has the marker, grey if it is unlabeled."""

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

    def draw(self, state: ArenaState) -> None:
        """Draw the latest markers, if they are recent."""
        timed = state.markers
        recent = timed is not None and state.age_s(timed) < MARKERS_S
        points = timed.message.positions() if timed is not None and recent else np.empty((0, 3))
        self._cloud.visible = len(points) > 0
        if timed is not None and len(points):
            labeled = timed.message.robot_index() >= 0
            self._cloud.points = points.astype(np.float32)
            self._cloud.colors = np.where(labeled[:, None], LABELED, UNLABELED).astype(np.uint8)


class TruePoints:
    """The demo's true marker positions, one point cloud per simulated object."""

    def __init__(self, scene: viser.SceneApi) -> None:
        self.scene = scene
        self.clouds: dict[str, Any] = {}

    def draw(self, state: ArenaState) -> None:
        """Draw the positions in the demo's latest message, if it is recent."""
        recent = state.progress and state.age_s(state.progress) < TRUE_POINTS_S
        objects = state.progress.message.true_points if state.progress and recent else {}
        for name in self.clouds.keys() - objects.keys():
            self.clouds.pop(name).remove()
        for name, points in objects.items():
            points = np.array(points, np.float32).reshape(-1, 3)
            if name in self.clouds:
                self.clouds[name].points = points
            elif len(points):
                self.clouds[name] = self.scene.add_point_cloud(
                    f"/true/{name}",
                    points,
                    TRUE_POINT,
                    point_size=0.05,
                    point_shape="circle",
                    precision="float32",
                )


class RobotDrawing:
    """Axes, bodies and trails of all robots, one batched handle each, and one label per robot."""

    def __init__(self, scene: viser.SceneApi) -> None:
        self.scene = scene
        self.trails = Trails()
        self._names: list[str] = []
        self._axes: Any = None
        self._bodies: Any = None
        self._trail_lines: Any = None
        self._labels: dict[str, Any] = {}

    def draw(self, state: ArenaState, trails: bool) -> None:
        """Draw the latest poses; `trails` also extends the trails."""
        names = sorted(state.poses)
        if not names:
            return
        poses = [state.poses[name].message for name in names]
        positions = np.array([pose.position for pose in poses], np.float32)
        wxyzs = np.array([pose.quaternion_wxyz for pose in poses], np.float32)
        tracking = [robot_state(state, name) for name in names]
        if names != self._names:
            self._create(names, positions, wxyzs)
        self._axes.batched_positions, self._axes.batched_wxyzs = positions, wxyzs
        self._bodies.batched_positions, self._bodies.batched_wxyzs = positions, wxyzs
        self._bodies.batched_colors = robot_colours(tracking)
        for name, position, robot in zip(names, positions, tracking, strict=True):
            self._labels[name].position = position + LABEL_OFFSET_M
            self._labels[name].text = name if robot == "tracked" else f"{name}: {robot}"
        if trails:
            self._extend_trails(names, positions, tracking)

    def _extend_trails(self, names: list[str], positions: ArrayLike, tracking: list[str]) -> None:
        for name, position, robot in zip(names, np.asarray(positions), tracking, strict=True):
            if robot in ("tracked", "coasting"):
                self.trails.add(name, position)
        self._trail_lines.points = self.trails.segments(names)

    def _create(self, names: list[str], positions: NDArray, wxyzs: NDArray) -> None:
        """Create the handles; a batched handle can not change its number of robots."""
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
        vertices, faces = cylinder_mesh(BODY_RADIUS_M, BODY_HEIGHT_M)
        own = _own_colours(len(names))
        self._bodies = self.scene.add_batched_meshes_simple(
            "/robots/bodies", vertices, faces, wxyzs, positions, batched_colors=own, opacity=0.75
        )
        self._trail_lines = self.scene.add_line_segments(
            "/robots/trails", self.trails.segments(names), fade(own, BACKGROUND), thickness=0.014
        )


def robot_colours(tracking: list[str]) -> NDArray[np.uint8]:
    """Return (R, 3) colours by tracking state: the robot's own while tracked, one for coasting, one for the rest."""
    colours = _own_colours(len(tracking))
    for row, robot in zip(colours, tracking, strict=True):
        if robot != "tracked":
            row[:] = COASTING if robot == "coasting" else LOST
    return colours


def _own_colours(count: int) -> NDArray[np.uint8]:
    return ROBOTS[np.arange(count) % len(ROBOTS)]


def cylinder_mesh(
    radius: float, height: float, sides: int = 32
) -> tuple[NDArray[np.float32], NDArray[np.uint32]]:
    """Return vertices (V, 3) and faces (F, 3) of a flat cylinder whose top is the plane z = 0 of the body."""
    angle = np.linspace(0, 2 * np.pi, sides, endpoint=False)
    circle = np.column_stack([radius * np.cos(angle), radius * np.sin(angle), np.zeros(sides)])
    vertices = np.vstack([circle, circle - [0, 0, height], [[0, 0, 0], [0, 0, -height]]])
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
