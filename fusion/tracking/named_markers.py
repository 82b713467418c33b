# SPDX-License-Identifier: BSD-3-Clause
"""Finds missing robots by the codes of their markers: without comparing distances.

A marker that two cameras name is triangulated, and its outlines and the turn of its code give its whole pose. Several
of a robot give its rotation by their positions, so that it does not matter how their cards are turned.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from camera_node.foundation.arrays import Array, Index
from camera_node.geometry.body import LINE_M, are_parallel
from fusion.model.likeness import align, distances
from fusion.model.observations import CameraArray, DetectionTable
from fusion.model.robots import Robot
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
        robot, first = table.robots[k], int(table.markers.first[k])
        seen = {
            row: _triangulate(cameras, detections, of, robot.diameter_m)
            for row, of in views.items()
            if len(set(detections.camera[of].tolist())) == len(of) >= MIN_VIEWS
        }
        by_number = {row - first: marker for row, marker in seen.items()}
        pose = _pose(cameras, robot, detections, by_number) if seen else None
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
    cameras: CameraArray, robot: Robot, detections: DetectionTable, seen: dict[int, Marker]
) -> tuple[Array, Array] | None:
    """R (3, 3) and p (3,) of a robot by its named markers (by number); None if these contradict.

    Positions show the rotation where they are not on a line; else positions and normals do; else, as of one marker,
    the zero of the code that most cameras read.
    """
    numbers, markers = np.array(list(seen), np.intp), list(seen.values())
    body, places = robot.points[numbers], np.array([marker.position for marker in markers])
    if not are_parallel(body - body[0]):
        return align(body, places)
    radius, reach_m = robot.diameter_m / 2, float(max(distances(body).max(), LINE_M))
    normals = np.array([start_rotation(cameras, detections, marker, radius)[0][:, 2] for marker in markers])
    body = np.concatenate([body, body + reach_m * robot.unit_normals[numbers]])
    places = np.concatenate([places, places + reach_m * normals])
    if are_parallel(body - body[0]):
        k = max(range(len(markers)), key=lambda k: len(markers[k].detections))
        zero = zero_of(cameras, detections, markers[k], normals[k], radius)
        if not np.isfinite(zero).all():
            return None
        body = np.concatenate([body, [body[k] + reach_m * robot.code_axes[numbers[k]]]])
        places = np.concatenate([places, [markers[k].position + reach_m * zero]])
    return align(body, places)


def read_codes(
    cameras: CameraArray, detections: DetectionTable, markers: Sequence[Marker], normals: Array
) -> tuple[Index, Array]:
    """Codes (K,) of triangulated markers, 0 without one or where cameras read several; and unit vectors (K, 3), world
    frame, to their zeros, NaN where unknown.

    Args:
        cameras: cameras of the rig.
        detections: of the frame set.
        markers: K of them.
        normals: (K, 3) of the markers, world frame, NaN where unknown.
    """
    codes, zeros = np.zeros(len(markers), np.intp), np.full((len(markers), 3), np.nan)
    if not (detections.code >= 0).any():
        return codes, zeros
    for k, marker in enumerate(markers):
        read = detections.code[marker.detections]
        names = np.unique(read[read >= 0])
        if len(names) != 1:
            continue
        codes[k], radius = names[0], marker.diameter_m / 2
        normal = normals[k]
        if not np.isfinite(normal).all():
            normal = start_rotation(cameras, detections, marker, radius)[0][:, 2]
        zeros[k] = zero_of(cameras, detections, marker, normal, radius)
    return codes, zeros


def zero_of(
    cameras: CameraArray, detections: DetectionTable, marker: Marker, normal: Array, radius: float
) -> Array:
    """(3,) unit vector, world frame, to the zero of a marker's code; NaN unless the cameras that read it agree."""
    read = marker.detections[np.isfinite(detections.rotation[marker.detections])]
    zeros = zeros_of(cameras, detections.select(read), marker.position, normal, radius)
    mean = zeros.mean(0) if len(zeros) else np.zeros(3)
    length = np.linalg.norm(mean)
    return mean / length if length > AGREE else np.full(3, np.nan)


def _reason(views: dict[int, Index], seen: dict[int, Marker]) -> str:
    if seen:
        return "cameras disagree about the heading of its code: is a print bent, or there twice?"
    if any(len(of) >= MIN_VIEWS for of in views.values()):
        return "its code is seen twice in one picture: print each code once"
    return f"fewer than {MIN_VIEWS} cameras read a code of it"
