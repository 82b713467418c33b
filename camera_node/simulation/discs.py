# SPDX-License-Identifier: BSD-3-Clause
"""Printed roundels in front of a camera, where its viewing rays intersect them, and where they are while it reads rows.

A rolling shutter sees each row of a disc at another time. The pose of the disc at a row is interpolated between its
poses at `NODES` times of the readout, by the polynomial through all of them.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TypeVar

import cv2
import numpy as np

from camera_node.foundation.arrays import Array
from camera_node.geometry import codes
from camera_node.geometry.body import Body, thickness_of
from camera_node.geometry.pose import rotation_with_z
from camera_node.simulation.floor import Picture

EDGE_ON = 0.02  # rad; discs seen at smaller angles are not drawn: they are less than half a pixel high
CORNERS = np.linspace(0, math.tau, 12, endpoint=False)
# A polygon around the unit circle.
POLYGON = np.column_stack([np.cos(CORNERS), np.sin(CORNERS)]) / math.cos(math.pi / 12)
# Heights (`Lens.image_row`) of Chebyshev's points. A body that turns by 0.12 rad in a readout (2 m/s on a circle of
# 0.5 m, 30 ms) is displaced by less than a micrometre.
NODES = -np.cos(np.pi * np.arange(5) / 4) / 2
MIDDLE = len(NODES) // 2
Key = TypeVar("Key")


@dataclass(frozen=True, slots=True)
class Disc:
    """A printed roundel in front of a camera: T_cam_disc (4, 4), and radii of card, black and white disc, metres.

    The zero of its `code`, 0 for none, is on the x axis.
    """

    T: Array
    radii: tuple[float, float, float]
    code: int = codes.PLAIN

    @property
    def faces_camera(self) -> bool:
        """Whether the camera sees the printed side at an angle of more than EDGE_ON radians."""
        t = self.T[:3, 3]
        return float(self.T[:3, 2] @ t) < -EDGE_ON * float(np.linalg.norm(t))

    @property
    def distance_m(self) -> float:
        """From the camera to the centre."""
        return float(np.linalg.norm(self.T[:3, 3]))

    @property
    def plane(self) -> Array:
        """(3, 3) matrix M with p = M (a, b, 1): the point p, camera frame, at (a, b) in the disc's plane."""
        return np.column_stack([self.T[:3, :2], self.T[:3, 3]])

    def outline(self) -> Array:
        """(12, 3) corners of a polygon around the card, camera frame, metres."""
        return self.radii[0] * POLYGON @ self.T[:3, :2].T + self.T[:3, 3]

    def intersect(self, rays: Picture, heights: Array) -> Picture:
        """Points (h, w, 2) of the disc's plane at which rays intersect it, from its centre, metres.

        Args:
            rays: (h, w, 2) x/z and y/z.
            heights: (h,) of the rows in the image (`Lens.image_row`).
        """
        return np.asarray(cv2.perspectiveTransform(rays, np.linalg.inv(self.plane)), np.float32)


@dataclass(frozen=True, slots=True)
class RollingDisc:
    """A roundel in front of a camera with a rolling shutter: where it is at each of the heights `NODES`."""

    discs: tuple[Disc, ...]

    @property
    def radii(self) -> tuple[float, float, float]:
        """Of card, black and white disc, metres."""
        return self.discs[MIDDLE].radii

    @property
    def code(self) -> int:
        """The number of its code, 0 for none."""
        return self.discs[MIDDLE].code

    @property
    def faces_camera(self) -> bool:
        """Whether the camera sees the printed side when it reads the middle row."""
        return self.discs[MIDDLE].faces_camera

    @property
    def distance_m(self) -> float:
        """From the camera to the centre when it reads the middle row."""
        return self.discs[MIDDLE].distance_m

    def outline(self) -> Array:
        """(N, 3) points that enclose the card during the whole readout, camera frame, metres."""
        return np.concatenate([disc.outline() for disc in self.discs])

    def intersect(self, rays: Picture, heights: Array) -> Picture:
        """As `Disc.intersect`, of each row with the disc at the time at which the row is read."""
        planes = np.array([disc.plane for disc in self.discs])
        return _points(np.linalg.inv(np.einsum("rk,kij->rij", _interpolation(heights), planes)), rays)


def place_discs(body: Body, T_cam_body: Array) -> list[Disc]:
    """The roundels of a body at T_cam_body (4, 4), visible or not."""
    outer = body.diameter_m / 2
    radii = (outer * body.card_ratio, outer, outer * body.inner_ratio)
    points, normals, half = body.points, body.unit_normals, thickness_of(body) / 2
    numbers = body.codes
    if half:
        points = np.concatenate([points + half * normals, points - half * normals])
        normals, numbers = np.concatenate([normals, -normals]), 2 * numbers
    T_body_disc = np.tile(np.eye(4), (len(points), 1, 1))
    T_body_disc[:, :3, :3], T_body_disc[:, :3, 3] = rotation_with_z(normals), points
    return [Disc(T, radii, code) for T, code in zip(T_cam_body @ T_body_disc, numbers, strict=True)]


def discs_while_read(
    discs_at: Callable[[float], Mapping[Key, Disc]], t_s: float, readout_s: float
) -> Mapping[Key, Disc] | Mapping[Key, RollingDisc]:
    """The roundels, by any key, in an image whose middle row is captured at `t_s`.

    Args:
        discs_at: the roundels at a time; those at `t_s` are drawn.
        t_s: seconds.
        readout_s: time in which a rolling shutter reads all rows (`Detections`); 0 of a global shutter.
    """
    if not readout_s:
        return discs_at(t_s)
    nodes = [discs_at(t_s + readout_s * height) for height in NODES.tolist()]
    return {
        key: RollingDisc(tuple(node.get(key, middle) for node in nodes))
        for key, middle in nodes[MIDDLE].items()
    }


def _interpolation(heights: Array) -> Array:
    """(N, K) weights of the values at `NODES` in the polynomial through them, at N heights."""
    return np.vander(heights, len(NODES)) @ np.linalg.inv(np.vander(NODES))


def _points(to_plane: Array, rays: Picture) -> Picture:
    """(h, w, 2) points of the plane, metres; each row's matrix (h, 3, 3) maps rays (x, y, 1) to (a, b, 1) s."""
    M, (x, y) = to_plane.astype(np.float32)[:, :, :, None], cv2.split(rays)
    a, b, s = (M[:, k, 0] * x + M[:, k, 1] * y + M[:, k, 2] for k in range(3))
    return np.asarray(np.stack([a / s, b / s], axis=-1), np.float32)
