# SPDX-License-Identifier: BSD-3-Clause
"""Draws robots with batched Viser handles, which cost 1/20 of single ones."""

from typing import Any

import numpy as np
import viser
from numpy.typing import ArrayLike, NDArray

from web.colours import BACKGROUND, own_colours, robot_colours
from web.feed import ArenaState
from web.scene.trails import Trails, fade
from web.tables import robot_state

BODY_RADIUS_M, BODY_HEIGHT_M = 0.13, 0.03
LABEL_OFFSET_M = np.array([0.0, 0.0, 0.16])
LABEL_SCALE = 0.8
LABEL_STEP_M = 0.01  # a label follows its robot in steps of so much
MAX_LABELS = 20  # moved in one slow drawing


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
        self._label_positions = np.empty((0, 3))
        self._next_label = 0

    def draw(self, state: ArenaState, is_slow: bool) -> None:
        """Draw the latest poses; labels and trails change in slow drawings only, which cost ten times as much."""
        names = sorted(state.poses)
        if names != self._names:
            self._create(names, *_poses(state, names))
        if not names:
            return
        positions, wxyzs = _poses(state, names)
        tracking = [robot_state(state, name) for name in names]
        self._axes.batched_positions, self._axes.batched_wxyzs = positions, wxyzs
        self._bodies.batched_positions, self._bodies.batched_wxyzs = positions, wxyzs
        if is_slow:
            self._bodies.batched_colors = robot_colours(names, tracking)
            self._draw_labels(names, positions, tracking)
            self._extend_trails(names, positions, tracking)

    def _draw_labels(self, names: list[str], positions: NDArray, tracking: list[str]) -> None:
        """Draw the labels that changed, at most `MAX_LABELS`, in turn: Viser has no batch of labels."""
        for name, robot in zip(names, tracking, strict=True):
            label, text = self._labels[name], name if robot == "tracked" else f"{name}: {robot}"
            if label.text != text:
                label.text = text
        wanted = positions + LABEL_OFFSET_M
        moved = np.flatnonzero(np.linalg.norm(wanted - self._label_positions, axis=1) > LABEL_STEP_M)
        first = np.searchsorted(moved, self._next_label)
        chosen = np.roll(moved, -first)[:MAX_LABELS]
        for k in chosen.tolist():
            self._labels[names[k]].position = wanted[k]
        self._label_positions[chosen] = wanted[chosen]
        self._next_label = int(chosen[-1]) + 1 if len(chosen) else 0

    def _extend_trails(self, names: list[str], positions: ArrayLike, tracking: list[str]) -> None:
        for name, position, robot in zip(names, np.asarray(positions), tracking, strict=True):
            if robot in ("tracked", "coasting"):
                self.trails.add(name, position)
        self._trail_lines.points = self.trails.segments(names)

    def _create(self, names: list[str], positions: NDArray, wxyzs: NDArray) -> None:
        """Create the handles; a batched handle can not change its number of robots."""
        for name in self._labels.keys() - set(names):
            self._labels.pop(name).remove()
            self.trails.remove(name)
        for handle in (self._axes, self._bodies, self._trail_lines):
            if handle is not None and not names:
                handle.remove()
        self._names = names
        self._label_positions, self._next_label = np.full((len(names), 3), np.inf), 0
        for name, position in zip(names, positions, strict=True):
            if name not in self._labels:
                self._labels[name] = self.scene.add_label(
                    f"/names/robots/{name}", name, anchor="bottom-center", font_screen_scale=LABEL_SCALE
                )
                self.trails.add(name, position)
        if names:
            self._create_batches(names, positions, wxyzs)

    def _create_batches(self, names: list[str], positions: NDArray, wxyzs: NDArray) -> None:
        self._axes = self.scene.add_batched_axes(
            "/robots/axes", wxyzs, positions, axes_length=0.22, axes_radius=0.008
        )
        vertices, faces = cylinder_mesh(BODY_RADIUS_M, BODY_HEIGHT_M)
        own = own_colours(names)
        self._bodies = self.scene.add_batched_meshes_simple(
            "/robots/bodies", vertices, faces, wxyzs, positions, batched_colors=own, opacity=0.75
        )
        self._trail_lines = self.scene.add_line_segments(
            "/robots/trails", self.trails.segments(names), fade(own, BACKGROUND), thickness=0.014
        )


def _poses(state: ArenaState, names: list[str]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Positions (R, 3) and quaternions (R, 4) of the latest poses."""
    poses = [state.poses[name].message for name in names]
    positions = np.array([pose.position for pose in poses], np.float32).reshape(-1, 3)
    return positions, np.array([pose.quaternion_wxyz for pose in poses], np.float32).reshape(-1, 4)


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
