# SPDX-License-Identifier: BSD-3-Clause
"""The errors of calibrated cameras, as users of a rig count them: covariances of all cameras together, and their size
in the image."""

from collections.abc import Sequence

import numpy as np

from calib.rig.camera import Camera, pixel_jacobians
from camera_node.foundation.arrays import Array

# The errors of a camera, by their columns: rotation and translation in its own frame (rad, m), clock offset (s), and
# logarithm of the focal length.
ERRORS = 8
# Error in the image of a rig that states no covariance: 0.01 to 0.06 px after a wand calibration with carefully
# calibrated lenses (`python -m tests.benchmarks.calibration`).
USUAL_PX = 0.05
GRID = np.linspace(0.1, 0.9, 5)  # of the image, where its error is computed


def error_covariance(cameras: Sequence[Camera]) -> Array:
    """(8 C, 8 C) covariance of the errors of C placed cameras; `USUAL_PX` for those that state none."""
    joint = np.zeros((len(cameras), ERRORS, len(cameras), ERRORS))
    for k, (camera, range_m) in enumerate(zip(cameras, working_ranges(cameras).tolist(), strict=True)):
        pose = usual_covariance(camera, range_m) if camera.covariance is None else np.array(camera.covariance)
        joint[k, :6, k, :6] = pose
    return joint.reshape(ERRORS * len(cameras), -1)


def usual_covariance(camera: Camera, range_m: float, error_px: float = USUAL_PX) -> Array:
    """(6, 6) of a pose whose rotation and position displace the image by `error_px` together, half the square each."""
    pixel = error_px / np.sqrt(2 * camera.fx * camera.fy)
    return np.diag(np.repeat([pixel, pixel * range_m], 3) ** 2)


def image_errors(cameras: Sequence[Camera], covariance: Array) -> Array:
    """(C,) RMS errors of the images by the errors of their cameras (8 C, 8 C), pixels, for each coordinate."""
    found = []
    for k, (camera, range_m) in enumerate(zip(cameras, working_ranges(cameras).tolist(), strict=True)):
        v, u = np.meshgrid(GRID * camera.height, GRID * camera.width, indexing="ij")
        rays = camera.rays(np.column_stack([u.ravel(), v.ravel()]))
        rays = rays[np.isfinite(rays).all(axis=1)]
        J = pixel_jacobians(camera, range_m * rays)[2]
        own = slice(ERRORS * k, ERRORS * k + 6)
        squares = np.einsum("nai,ij,naj->n", J, covariance[own, own], J)
        found.append(np.sqrt(squares.mean() / 2) if len(squares) else 0.0)
    return np.array(found)


def working_ranges(cameras: Sequence[Camera]) -> Array:
    """(C,) distances of placed cameras from the point nearest to all optical axes, metres; from the other cameras where
    these are parallel, and 1 for a single camera."""
    T = np.array([camera.matrix() for camera in cameras]).reshape(-1, 4, 4)
    centres, axes = T[:, :3, 3], T[:, :3, 2]
    across = np.eye(3) - axes[:, :, None] * axes[:, None]
    A, b = across.sum(axis=0), np.einsum("nij,nj->i", across, centres)
    point = np.linalg.lstsq(A + 1e-3 * np.eye(3) * len(T), b + 1e-3 * centres.sum(axis=0), rcond=None)[0]
    ranges = np.linalg.norm(centres - point, axis=1)
    return np.where(ranges > np.finfo(float).eps ** 0.5, ranges, 1.0)  # but for rounding
