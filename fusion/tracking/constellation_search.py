# SPDX-License-Identifier: BSD-3-Clause
"""Finds where the distances and the visibility of triangulated markers allow constellations to be."""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from camera_node.foundation.arrays import Array, Index, Mask
from camera_node.foundation.columns import Columns
from camera_node.geometry.pose import rigid_motions
from fusion import _core
from fusion.model.likeness import MIN_MARKERS, distances
from fusion.model.observations import CameraArray
from fusion.model.robots import Robot
from fusion.tracking.gating import DIAMETER_TOLERANCE
from fusion.tracking.rays import Marker

SIGMAS = 3.0
SLACK_M = 0.004  # of a distance: markers are glued on by hand
# Limits of one robot: steps of the search, and mappings with one number of markers. Above them, as where late frames
# make distances uncertain by decimetres, the shape is not distinctive.
MAX_STEPS, MAX_MAPPINGS = 500_000, 1_000


@dataclass(frozen=True, slots=True, eq=False)
class TriangulatedMarkers:
    """N unassigned triangulated markers.

    Attributes:
        position, covariance: (N, 3) and (N, 3, 3), world frame.
        diameter_m: (N,), NaN where unknown.
        to_cameras: (N, C, 3) vectors to the cameras that saw the marker, NaN for the others.
    """

    position: Array
    covariance: Array
    diameter_m: Array
    to_cameras: Array

    @classmethod
    def of(cls, markers: list[Marker], cameras: CameraArray) -> "TriangulatedMarkers":
        """The scene of these markers."""
        position = np.array([marker.position for marker in markers]).reshape(-1, 3)
        to_cameras = np.full((len(markers), len(cameras.names), 3), np.nan)
        for to, marker in zip(to_cameras, markers, strict=True):
            to[marker.cameras] = cameras.centres[marker.cameras] - marker.position
        covariance = np.array([marker.covariance for marker in markers]).reshape(-1, 3, 3)
        return cls(position, covariance, np.array([marker.diameter_m for marker in markers]), to_cameras)

    def __len__(self) -> int:
        return len(self.position)

    def with_diameter(self, diameter_m: float) -> Mask:
        """(N,) markers that have this diameter, or an unknown one."""
        return ~(np.abs(self.diameter_m / diameter_m - 1) >= DIAMETER_TOLERANCE)


@dataclass(frozen=True, slots=True, eq=False)
class Mappings(Columns):
    """K mappings, each of L markers of a robot to points.

    Attributes:
        robot: (K,) rows.
        numbers: (K, L) the robot's markers.
        points: (K, L) triangulated markers.
    """

    robot: Index
    numbers: Index
    points: Index


@dataclass(frozen=True, slots=True, eq=False)
class Fits(Columns):
    """K mappings with the poses R (K, 3, 3), t (K, 3) of the robots that fit best, world frame."""

    mappings: Mappings
    R: Array
    t: Array


@dataclass(frozen=True, slots=True)
class Candidates:
    """What a search found.

    Attributes:
        tables: by robot, (K, M) mappings: the point of each of its markers, -1 for unseen ones.
        crowded: robots with too many mappings, some or all of which are missing in `tables`.
    """

    tables: dict[int, Index]
    crowded: frozenset[int]

    def with_markers(self, count: int) -> Mappings:
        """The mappings of `count` markers."""
        parts = [_with_markers(robot, table, count) for robot, table in self.tables.items()]
        none = np.empty((0, count), np.intp)
        return Mappings(none[:, 0], none, none).joined(*parts)


def search(robots: dict[int, Robot], scene: TriangulatedMarkers) -> Candidates:
    """Find all maximal mappings of three or more markers of robots, by row, with all distances within tolerance."""
    if len(scene) < MIN_MARKERS or not robots:
        return Candidates({}, frozenset())
    reach_m = max(float(_shape(robot)[0].max()) for robot in robots.values())
    flat = not any(robot.normals for robot in robots.values())
    to_cameras = scene.to_cameras[:, :0] if flat else scene.to_cameras  # `fit` compares these too
    views = np.ascontiguousarray(to_cameras)
    cloud = _core.MarkerCloud(scene.position, scene.covariance, views, SLACK_M, SIGMAS, reach_m)
    tables, crowded = {}, set()
    for row, robot in robots.items():
        usable = scene.with_diameter(robot.diameter_m)
        tables[row], complete = cloud.mappings(*_shape(robot), usable, MAX_STEPS, MAX_MAPPINGS)
        if not complete:
            crowded.add(row)
    return Candidates(tables, frozenset(crowded))


@lru_cache(512)  # twice the robots of an arena
def _shape(robot: Robot) -> tuple[Array, Array]:
    """(M, M) distances between the markers of a robot, and `_angles`."""
    return distances(robot.points), _angles(robot)


def _angles(robot: Robot) -> Array:
    """(M, M) angles between the normal of each marker (row) and the directions to the others (column), rad."""
    between = robot.points - robot.points[:, None]
    along = np.einsum("mki,mi->mk", between, robot.unit_normals)
    return np.arccos(np.clip(along / np.maximum(np.linalg.norm(between, axis=2), 1e-9), -1, 1))


def fit(mappings: Mappings, robots: dict[int, Robot], scene: TriangulatedMarkers) -> Fits:
    """The best poses of mappings in which all prints face the cameras that saw them."""
    body, normals = _body_markers(mappings, robots)
    T = rigid_motions(body, scene.position[mappings.points])
    normals = np.einsum("kij,klj->kli", T[:, :3, :3], normals)
    along = np.einsum("klcj,klj->klc", scene.to_cameras[mappings.points], normals)
    faces = ~(along <= 0).any((1, 2))  # NaN for cameras that did not see the marker
    return Fits(mappings.select(faces), T[faces, :3, :3], T[faces, :3, 3])


def _body_markers(mappings: Mappings, robots: dict[int, Robot]) -> tuple[Array, Array]:
    """(K, L, 3) the mapped markers in the frames of their robots, and (K, L, 3) their normals."""
    used = np.unique(mappings.robot).tolist()
    first = dict(zip(used, np.cumsum([0, *(len(robots[k].markers) for k in used)]).tolist(), strict=False))
    points = np.concatenate([np.empty((0, 3)), *(robots[k].points for k in used)])
    normals = np.concatenate([np.empty((0, 3)), *(robots[k].unit_normals for k in used)])
    rows = np.array([first[k] for k in mappings.robot.tolist()], np.intp)[:, None] + mappings.numbers
    return points[rows], normals[rows]


def _with_markers(robot: int, table: Index, count: int) -> Mappings:
    """The mappings of a robot's table (K, M) that have `count` markers."""
    rows = table[(table >= 0).sum(1) == count]
    numbers = np.nonzero(rows >= 0)[1].reshape(-1, count)
    return Mappings(np.full(len(rows), robot), numbers, np.take_along_axis(rows, numbers, 1))
