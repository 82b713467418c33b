# SPDX-License-Identifier: BSD-3-Clause
"""Finds missing robots by the codes of their markers: without comparing distances.

A marker that two cameras name is triangulated, and its outlines and the turn of its code give its whole pose. Three of
a robot give a more accurate rotation by their positions.
"""

from dataclasses import dataclass

import numpy as np

from camera_node.foundation.arrays import Array, Index
from fusion.model.likeness import align
from fusion.model.observations import CameraArray, DetectionTable
from fusion.tracking.constellation_search import MIN_MARKERS
from fusion.tracking.headings import zeros_of
from fusion.tracking.normals import start_rotation
from fusion.tracking.rays import Marker, diameters_of, rays_of, triangulate
from fusion.tracking.track_table import TrackTable

MIN_VIEWS = 2  # cameras that determine a range
AGREE = 0.9  # length of the mean of unit vectors that agree within 25 degrees


@dataclass(frozen=True, slots=True)
class NamedRobots:
    """K missing robots (rows) that their codes show.

    Attributes:
        robots: rows.
        R, p: (K, 3, 3) and (K, 3).
        markers: of each, by row of the marker table.
        reasons: why the others are not found, by row.
    """

    robots: list[int]
    R: Array
    p: Array
    markers: list[dict[int, Marker]]
    reasons: dict[int, str]


def find_named(
    cameras: CameraArray, table: TrackTable, missing: Index, detections: DetectionTable, free: Index
) -> NamedRobots:
    """Find coded robots.

    Args:
        cameras: cameras of the rig.
        table: of all robots.
        missing: rows of the coded robots to find.
        detections: of the frame set.
        free: rows of the detections that are not assigned.
    """
    named = free[detections.code[free] >= 0]
    robots, poses, markers, reasons = [], [], [], {}
    for k in missing.tolist():
        own = np.flatnonzero((table.markers.robot == k) & (table.markers.code > 0))
        views = {row: named[detections.code[named] == table.markers.code[row]] for row in own.tolist()}
        seen = {
            row: _triangulate(cameras, detections, of, table.robots[k].diameter_m)
            for row, of in views.items()
            if len(set(detections.camera[of].tolist())) == len(of) >= MIN_VIEWS
        }
        pose = _pose(cameras, table, detections, seen) if seen else None
        if pose is None:
            reasons[k] = _reason(views, seen)
            continue
        robots.append(k)
        poses.append(pose)
        markers.append(seen)
    R, p = (np.array([pose[part] for pose in poses]) for part in (0, 1))
    return NamedRobots(robots, R.reshape(-1, 3, 3), p.reshape(-1, 3), markers, reasons)


def _triangulate(cameras: CameraArray, detections: DetectionTable, rows: Index, diameter_m: float) -> Marker:
    rays, group = rays_of(cameras, detections, rows, np.array([diameter_m])), np.zeros(len(rows), np.intp)
    near = np.nanmean(rays.o + rays.d * (diameter_m / rays.size)[:, None], axis=0)
    position, covariance = triangulate(rays, group, np.nan_to_num(near)[None])
    size = float(diameters_of(rays, group, position)[0])
    return Marker(position[0], covariance[0], rows, detections.camera[rows], size)


def _pose(
    cameras: CameraArray, table: TrackTable, detections: DetectionTable, seen: dict[int, Marker]
) -> tuple[Array, Array] | None:
    """R (3, 3) and p (3,) of a robot by its named markers (rows of the marker table); None if these contradict."""
    rows = np.array(list(seen), np.intp)
    body = table.markers.position[:, rows].T
    places = np.array([marker.position for marker in seen.values()])
    if len(rows) >= MIN_MARKERS and np.linalg.matrix_rank(body - body[0], tol=0.02) == 2:
        return align(body, places)
    row, marker = max(seen.items(), key=lambda item: len(item[1].detections))
    radius = float(table.markers.radius[row])
    normal = start_rotation(cameras, detections, marker, radius)[0][:, 2]
    read = marker.detections[np.isfinite(detections.rotation[marker.detections])]
    zeros = zeros_of(cameras, detections.select(read), marker.position, normal, radius)
    mean = zeros.mean(0) if len(zeros) else np.zeros(3)
    if not np.linalg.norm(mean) > AGREE:
        return None
    seen_axes = _axes(mean / np.linalg.norm(mean), normal)
    R = seen_axes @ _axes(table.markers.zero[:, row], table.markers.normal[:, row]).T
    return R, marker.position - R @ table.markers.position[:, row]


def _axes(zero: Array, normal: Array) -> Array:
    """(3, 3) columns: the zero of a code, a quarter turn from it, and the normal."""
    return np.column_stack([zero, np.cross(normal, zero), normal])


def _reason(views: dict[int, Index], seen: dict[int, Marker]) -> str:
    if seen:
        return "cameras disagree about the heading of its code: is a print bent, or there twice?"
    if any(len(of) >= MIN_VIEWS for of in views.values()):
        return "its code is seen twice in one picture: print each code once"
    return f"fewer than {MIN_VIEWS} cameras read a code of it"
