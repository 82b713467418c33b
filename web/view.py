# SPDX-License-Identifier: BSD-3-Clause
"""The live view: a Viser server that draws what a `Feed` knows, thirty times a second."""

import math
import os
import socket
import threading
import time
from typing import Any

import numpy as np
import viser
from numpy.typing import ArrayLike, NDArray

from calib.camera import Camera
from calib.rig import Rig
from camera_node.pose import wxyz_from_rotation
from web.errors import WebError
from web.feed import FAR_M, Feed, Latest
from web.panel import Panel
from web.tables import robot_state
from web.trails import Trails, fade

PERIOD_S = 1 / 30
TRAIL_EVERY = 3  # frames
PANEL_EVERY = 15
BACKGROUND = (1, 1, 2)
CAMERA, GHOST, LABELLED, UNLABELLED = (122, 162, 247), (235, 238, 245), (255, 255, 255), (150, 150, 150)
COASTING, LOST = (222, 99, 10), (40, 20, 20)
# Viser's meshes and lines take colours as linear light: (c / 255)^2.2 of what is to be seen.
ROBOTS = np.array(
    [[12, 150, 105], [238, 47, 70], [53, 119, 255], [255, 154, 38], [129, 84, 238], [89, 159, 37]], np.uint8
)
BODY_RADIUS_M, BODY_HEIGHT_M = 0.13, 0.03
LABEL_ABOVE = np.array([0.0, 0.0, 0.16])


class View:
    """The page that browsers see. `update` draws one frame; `run` draws until it is told to stop."""

    def __init__(self, feed: Feed, host: str = "127.0.0.1", port: int = 8080) -> None:
        """Raises WebError where the port can't be had."""
        check_port(host, port)
        self.feed = feed
        self.server = viser.ViserServer(host=host, port=port, label="Roundel", verbose=False)
        self.server.gui.configure_theme(
            dark_mode=True, control_width="large", show_logo=False, show_share_button=False
        )
        self.panel = Panel(self.server, feed, self.frame_arena)
        self._frames = 0
        self._rig: Rig | None = None
        self._cameras: list[Any] = []
        self._robots = _Robots(self.server.scene)
        self._markers = _Markers(self.server.scene)
        self._ghosts: dict[str, Any] = {}
        _light(self.server.scene)
        self.server.scene.add_grid(
            "/floor",
            width=12.0,
            height=12.0,
            cell_color=(46, 49, 56),
            section_color=(72, 77, 88),
            fade_distance=14.0,
            fade_strength=2.0,
            fade_from="origin",
        )
        self.frame_arena()

    @property
    def url(self) -> str:
        """Where a browser finds the page."""
        return f"http://{self.server.get_host()}:{self.server.get_port()}"

    def run(self, stop: threading.Event) -> None:
        """Draw until `stop` is set; late frames are left out, not caught up."""
        due = time.monotonic()
        while not stop.wait(max(0.0, due - time.monotonic())):
            due = max(due + PERIOD_S, time.monotonic())
            try:
                self.update()
            except Exception as error:  # one frame that can't be drawn must not end the view
                self.feed.count_fault(f"drawing: {error!r}"[:120])

    def close(self) -> None:
        """Close the page and free its port."""
        self.server.stop()

    def update(self) -> None:
        """Draw what is known now."""
        latest = self.feed.latest()
        with self.server.atomic():
            if latest.rig is not self._rig:
                self._draw_rig(latest.rig)
            self._robots.draw(latest, trails=self._frames % TRAIL_EVERY == 0)
            self._markers.draw(latest)
            self._draw_ghosts(latest)
            if self._frames % PANEL_EVERY == 0:
                self.panel.update(latest)
        self._frames += 1

    def frame_arena(self) -> None:
        """Turn every browser's view, and that of those to come, to the whole arena."""
        position, target = frame(self._rig)
        self.server.initial_camera.position = position
        self.server.initial_camera.look_at = target
        for client in self.server.get_clients().values():
            client.camera.position = position
            client.camera.look_at = target

    def _draw_rig(self, rig: Rig | None) -> None:
        for handle in self._cameras:
            handle.remove()
        first, self._rig, self._cameras = self._rig is None, rig, []
        for name, camera in (rig.placed() if rig else {}).items():
            self._cameras += _draw_camera(self.server.scene, name, camera)
        if first:
            self.frame_arena()

    def _draw_ghosts(self, latest: Latest) -> None:
        ghosts = latest.progress.message.ghosts if latest.progress and latest.progress.age() < 1.0 else {}
        for name in self._ghosts.keys() - ghosts.keys():
            self._ghosts.pop(name).remove()
        for name, points in ghosts.items():
            points = np.array(points, np.float32).reshape(-1, 3)
            if name in self._ghosts:
                self._ghosts[name].points = points
            elif len(points):
                self._ghosts[name] = self.server.scene.add_point_cloud(
                    f"/ghosts/{name}",
                    points,
                    GHOST,
                    point_size=0.05,
                    point_shape="circle",
                    precision="float32",
                )


def check_port(host: str, port: int) -> None:
    """Raise WebError unless the port can be listened on; Viser itself would silently take the next free one."""
    try:
        with socket.create_server((host, port)):
            pass
    except (OSError, OverflowError) as error:
        reason = os.strerror(error.errno) if isinstance(error, OSError) and error.errno else error
        raise WebError(f"can't show a page on {host}:{port} ({reason}); choose another with --port") from None


def frame(rig: Rig | None) -> tuple[tuple[float, float, float], tuple[float, float, float]]:
    """From where to look, and at what, to have the whole rig in sight, metres."""
    centres = [camera.matrix()[:3, 3] for camera in (rig.placed() if rig else {}).values()]
    low, high = (np.min(centres, 0), np.max(centres, 0)) if centres else (np.full(3, -2.0), np.full(3, 2.0))
    middle = (low + high) / 2
    target = np.array([middle[0], middle[1], 0.3 * high[2]])
    reach = max(1.5, float(np.linalg.norm(high - low)) / 2)
    eye = target + reach * np.array([0.75, -1.25, 0.62])
    return tuple(eye.tolist()), tuple(target.tolist())


def _light(scene: viser.SceneApi) -> None:
    """One sun and a soft sky: Viser's own lights wash colours out on a dark ground."""
    scene.configure_default_lights(enabled=False)
    scene.configure_environment_map(None)
    scene.add_light_ambient("/lights/sky", intensity=1.2)
    scene.add_light_directional("/lights/sun", intensity=1.6, position=(2.0, -3.0, 5.0))


def _draw_camera(scene: viser.SceneApi, name: str, camera: Camera) -> list[Any]:
    T = camera.matrix()
    frustum = scene.add_camera_frustum(
        f"/cameras/{name}",
        fov=2 * math.atan(camera.height / (2 * camera.fy)),
        aspect=camera.width * camera.fy / (camera.height * camera.fx),
        scale=0.22,
        thickness=0.01,
        color=CAMERA,
        variant="filled",
        wxyz=wxyz_from_rotation(T[:3, :3]),
        position=T[:3, 3],
    )
    above = T[:3, 3] + [0.0, 0.0, 0.12]
    label = scene.add_label(f"/names/cameras/{name}", name, position=above, anchor="bottom-center")
    return [frustum, label]


class _Markers:
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
        points = seen.message.positions() if seen is not None and seen.age() < 0.5 else np.empty((0, 3))
        known = (np.abs(points) < FAR_M).all(axis=1)  # NaN is not
        self._cloud.visible = bool(known.any())
        if seen is not None and known.any():
            labelled = seen.message.robot_index()[known] >= 0
            self._cloud.points = points[known].astype(np.float32)
            self._cloud.colors = np.where(labelled[:, None], LABELLED, UNLABELLED).astype(np.uint8)


class _Robots:
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
        states = [robot_state(latest.poses[name]) for name in names]
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
