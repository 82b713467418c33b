# SPDX-License-Identifier: BSD-3-Clause
"""Shapes of robots in the scene: what encloses a robot's markers, and meshes that are fixed to robots in batches."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import viser
from numpy.typing import NDArray

from camera_node.foundation.arrays import Array, Index
from camera_node.geometry.body import Body
from camera_node.geometry.pose import rotation_with_z, wxyz_from_rotation
from fusion.model.likeness import sides

# Of a plate below unknown prints; its height; how far it reaches beyond the cards.
UNKNOWN_RADIUS_M, PLATE_M, BORDER_M = 0.13, 0.03, 0.03
Mesh = tuple[NDArray[np.float32], NDArray[np.uint32]]


@dataclass(frozen=True)
class Part:
    """A mesh of unit size on a robot: where it is in the robot's frame, and its size along its own axes, metres."""

    is_box: bool
    position: Array
    R: Array
    size: Array


def enclosing_part(body: Body | None) -> Part:
    """What encloses the markers of a robot: a box if they are on several sides, else a round plate below them.

    Args:
        body: None if the page does not know the robot's markers: a plate below its origin.
    """
    if body is None:
        return Part(False, np.zeros(3), np.eye(3), np.array([UNKNOWN_RADIUS_M, UNKNOWN_RADIUS_M, PLATE_M]))
    card_m = body.card_ratio * body.diameter_m / 2
    R = _axes(body.unit_normals)
    points, normals = body.points @ R, body.unit_normals @ R
    if len(sides(body)) == 1:
        low, high = points.min(0), points.max(0)
        centre = np.array([*(low + high)[:2] / 2, low[2]])
        radius = np.linalg.norm((points - centre)[:, :2], axis=1).max() + card_m + BORDER_M
        return Part(False, R @ centre, R, np.array([radius, radius, PLATE_M]))
    reach = card_m * np.sqrt(np.maximum(1 - normals**2, 0))  # of a card along each axis
    low, high = (points - reach).min(0), (points + reach).max(0)
    return Part(True, R @ (low + high) / 2, R, high - low)


def _axes(normals: Array) -> Array:
    """(3, 3) columns x, y, z: z is the first normal, x the one that differs most from it, made perpendicular."""
    R = rotation_with_z(normals[0])
    other = normals[np.argmin(np.abs(normals @ normals[0]))]
    other = other - (other @ normals[0]) * normals[0]
    if (length := np.linalg.norm(other)) > 0.5:
        return np.column_stack([other / length, np.cross(normals[0], other / length), normals[0]])
    return R


class FixedParts:
    """Copies of one mesh that are fixed to robots: one batched handle, which costs 1/20 of single ones.

    Args:
        scene: the scene.
        name: of its node.
        mesh: vertices and faces, of unit size.
        opacity: 1 is opaque.
    """

    def __init__(self, scene: viser.SceneApi, name: str, mesh: Mesh, opacity: float | None = None) -> None:
        self._scene, self._name, self._mesh, self._opacity = scene, name, mesh, opacity
        self._rows = np.empty(0, np.intp)  # of the robots
        self._points, self._rotations = np.empty((0, 3)), np.empty((0, 3, 3))
        self.handle: Any = None

    def create(self, rows: Index, parts: list[Part], colours: NDArray[np.uint8]) -> None:
        """Replace all copies; a batched handle can not change its number of copies.

        Args:
            rows: (K,) the robot of each copy, a row of the poses that `move` gets.
            parts: K places and sizes.
            colours: (K, 3).
        """
        if self.handle is not None:
            self.handle.remove()
            self.handle = None
        self._rows = rows
        if not parts:
            return
        self._points = np.array([part.position for part in parts])
        self._rotations = np.array([part.R for part in parts])
        self.handle = self._scene.add_batched_meshes_simple(
            self._name,
            *self._mesh,
            np.tile(np.array([1, 0, 0, 0], np.float32), (len(parts), 1)),
            self._points.astype(np.float32),
            batched_scales=np.array([part.size for part in parts], np.float32),
            batched_colors=colours,
            opacity=self._opacity,
            flat_shading=True,
        )

    def move(self, positions: Array, rotations: Array) -> None:
        """Move the copies with the robots' poses: (R, 3) and (R, 3, 3)."""
        if self.handle is None:
            return
        of = rotations[self._rows]
        at = positions[self._rows] + np.einsum("kij,kj->ki", of, self._points)
        self.handle.batched_positions = at.astype(np.float32)
        self.handle.batched_wxyzs = wxyz_from_rotation(of @ self._rotations).astype(np.float32)

    def paint(self, colours: NDArray[np.uint8]) -> None:
        """Set the colours (K, 3) of the copies, if one differs: they are as many bytes as the motion."""
        if self.handle is not None and not np.array_equal(self.handle.batched_colors, colours):
            self.handle.batched_colors = colours

    def of_robots(self, colours: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """(K, 3) the copies' colours where each has its robot's (R, 3)."""
        return colours[self._rows]


def cylinder_mesh(radius: float, height: float, sides: int = 32) -> Mesh:
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


def box_mesh() -> Mesh:
    """Vertices (8, 3) and faces (12, 3) of a cube of 1 m around the origin."""
    corners = [(x, y, z) for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)]
    sides = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    faces = [face for a, b, c, d in sides for face in ((a, b, c), (a, c, d))]
    return np.array(corners, np.float32), np.array(faces, np.uint32)


def ring_mesh(inner: float, sides: int = 24) -> Mesh:
    """Vertices and faces of a flat ring that faces +z, of outer radius 1; an inner radius of 0 makes a disc."""
    angle = np.linspace(0, 2 * np.pi, sides, endpoint=False)
    circle = np.column_stack([np.cos(angle), np.sin(angle), np.zeros(sides)])
    a = np.arange(sides)
    b = (a + 1) % sides
    faces = np.vstack([np.column_stack([a, b, a + sides]), np.column_stack([b, b + sides, a + sides])])
    return np.vstack([circle, inner * circle]).astype(np.float32), faces.astype(np.uint32)
