# SPDX-License-Identifier: BSD-3-Clause
"""Estimates the normal of a single marker from the outlines in all its views.

A module of its own because acquisition and the unlabeled tracker both start single markers with it.
"""

import numpy as np

from camera_node.foundation.arrays import Array
from camera_node.geometry.sphere import fibonacci_sphere
from fusion import _core
from fusion.model.observations import CameraArray, DetectionTable
from fusion.tracking.gating import AXIS_SIGMA_PX, DECISIVE_CHI2
from fusion.tracking.rays import Marker

DIRECTIONS = 600  # tested on the sphere, about 9 degrees apart; the estimator refines the best one
SAME_NORMAL = np.cos(np.radians(40))  # cosine above which two directions count as one solution


def start_rotation(
    cameras: CameraArray, detections: DetectionTable, marker: Marker, radius: float
) -> tuple[Array, bool]:
    """The rotation (3, 3) to start a marker with, and whether the views determine its normal.

    Where they do not, the marker faces the mean direction of its cameras.
    """
    normal = find_normal(cameras, detections, marker, radius)
    if normal is not None:
        return rotation_to(normal), True
    to = cameras.centres[np.unique(marker.cameras)] - marker.position
    mean = (to / np.linalg.norm(to, axis=1, keepdims=True)).sum(0)
    return rotation_to(mean / np.linalg.norm(mean)), False


def find_normal(
    cameras: CameraArray, detections: DetectionTable, marker: Marker, radius: float
) -> Array | None:
    """The unit normal (3,), world frame, that minimizes the shears; None if another direction fits as well."""
    seen = detections.select(marker.detections)
    seen = seen.select(np.flatnonzero(np.isfinite(seen.axes_px[0])))
    normals = fibonacci_sphere(DIRECTIONS)
    to = cameras.centres[seen.camera] - marker.position
    normals = normals[(normals @ to.T > 0).all(1)]
    if not len(seen) or not len(normals):
        return None
    chi2 = _chi2(cameras, seen, (normals, to), radius)
    best = int(np.argmin(chi2))
    elsewhere = chi2[normals @ normals[best] < SAME_NORMAL]
    return normals[best] if not len(elsewhere) or elsewhere.min() > chi2[best] + DECISIVE_CHI2 else None


def _chi2(cameras: CameraArray, seen: DetectionTable, vectors: tuple[Array, Array], radius: float) -> Array:
    """(n,) chi-square of the shears, for normals (n, 3) and vectors (v, 3) from the marker to the cameras."""
    normals, to = vectors
    n, v = len(normals), len(seen)
    R = cameras.R_cam_world[seen.camera]
    centre = np.einsum("vij,vj->iv", R, -to)
    every = np.tile(np.arange(v), n)
    shears = _core.shears(
        seen.axes_px[:, every],
        seen.angle_rad[every],
        centre[:, every],
        np.einsum("vij,nj->inv", R, normals).reshape(3, -1),
        np.full(n * v, radius),
        seen.scale[:, :, every],
    )
    sigma = 2 * AXIS_SIGMA_PX / seen.axes_px[1]
    return ((shears.reshape(2, n, v) / sigma) ** 2).sum((0, 2))


def rotation_to(normal: Array) -> Array:
    """The (3, 3) rotation of smallest angle that turns +z to `normal` (3,)."""
    x, y, z = normal
    if z < -1 + 1e-9:
        return np.diag([1.0, -1.0, -1.0])
    V = np.array([[0, 0, x], [0, 0, y], [-x, -y, 0]])
    return np.eye(3) + V + V @ V / (1 + z)
