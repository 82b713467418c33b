# SPDX-License-Identifier: BSD-3-Clause
"""Which way a single marker faces: the normal that explains the outlines of all views at once."""

import numpy as np

from camera_node.arrays import Array
from camera_node.geometry.sphere import fibonacci_sphere
from fusion import _core
from fusion.model.camera_array import CameraArray
from fusion.model.observations import DetectionTable
from fusion.tracking.estimator import AXIS_SIGMA_PX
from fusion.tracking.multiview import Marker

DIRECTIONS = 600  # over the sphere, about 9 degrees apart: the estimator does the rest
CLEARLY = 9.0  # chi-square by which a normal elsewhere must be worse
ELSEWHERE = np.cos(np.radians(40))


def find_normal(
    optics: CameraArray, sightings: DetectionTable, marker: Marker, radius: float
) -> Array | None:
    """The unit normal (3,) in the world, or None where the views do not settle it."""
    seen = sightings.select(marker.sightings)
    seen = seen.select(np.flatnonzero(np.isfinite(seen.axes_px[0])))
    normals = fibonacci_sphere(DIRECTIONS)
    to = optics.centres[seen.camera] - marker.position
    normals = normals[(normals @ to.T > 0).all(1)]
    if not len(seen) or not len(normals):
        return None
    n, v = len(normals), len(seen)
    R = optics.R_cam_world[seen.camera]
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
    chi2 = ((shears.reshape(2, n, v) / sigma) ** 2).sum((0, 2))
    best = int(np.argmin(chi2))
    elsewhere = chi2[normals @ normals[best] < ELSEWHERE]
    return normals[best] if not len(elsewhere) or elsewhere.min() > chi2[best] + CLEARLY else None


def rotation_to(normal: Array) -> Array:
    """The (3, 3) rotation of least angle that brings +z to `normal` (3,)."""
    x, y, z = normal
    if z < -1 + 1e-9:
        return np.diag([1.0, -1.0, -1.0])
    V = np.array([[0, 0, x], [0, 0, y], [-x, -y, 0]])
    return np.eye(3) + V + V @ V / (1 + z)
