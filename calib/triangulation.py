# SPDX-License-Identifier: BSD-3-Clause
"""A point seen by several placed cameras, and how well it is known: by their pixels and by their own poses."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from calib.camera import Camera, transform
from calib.errors import CalibrationError
from camera_node.pose import invert

Array = NDArray[np.float64]

MIN_ANGLE = 0.01  # radians between rays, about: nearer to parallel, they fix no point
ITERATIONS = 8


def triangulate_point(cameras: Sequence[Camera], uv: ArrayLike) -> Array:
    """The point (3,) nearest to all viewing rays, then of the least squared reprojection error (Gauss-Newton).

    Args:
        cameras: the N >= 2 placed cameras that saw it.
        uv: (N, 2) raw pixels.

    Raises:
        CalibrationError: the rays are too close to parallel to fix a point.
    """
    uv = np.asarray(uv, float)
    p = _nearest_to_rays(cameras, uv)
    for _ in range(ITERATIONS):
        J, r = _linearise(cameras, uv, p)
        if not np.isfinite(J).all():
            break
        p = p + np.linalg.lstsq(J, r)[0]
    if not np.isfinite(p).all():
        raise CalibrationError("the viewing rays meet behind the cameras")
    return p


def _nearest_to_rays(cameras: Sequence[Camera], uv: Array) -> Array:
    A, b = np.zeros((3, 3)), np.zeros(3)
    for camera, pixel in zip(cameras, uv, strict=True):
        T = camera.matrix()
        d = T[:3, :3] @ camera.rays(pixel)[0]
        across = np.eye(3) - np.outer(d, d)
        A, b = A + across, b + across @ T[:3, 3]
    if not np.isfinite(A).all() or np.linalg.eigvalsh(A)[0] < MIN_ANGLE**2:
        raise CalibrationError("the viewing rays are too close to parallel to fix a point")
    return np.asarray(np.linalg.solve(A, b), float)


def _linearise(cameras: Sequence[Camera], uv: Array, p: Array) -> tuple[Array, Array]:
    """Jacobian (2N, 3) of the pixels by the point, and seen less expected pixels (2N,)."""
    rows, rest = [], []
    for camera, pixel in zip(cameras, uv, strict=True):
        T = camera.matrix()
        expected, J = camera.project_with_jacobian(transform(invert(T), p))
        rows.append(J[0] @ T[:3, :3].T)
        rest.append(pixel - expected[0])
    return np.vstack(rows), np.concatenate(rest)


def point_covariances(cameras: Sequence[Camera], points: ArrayLike, sigma_px: float) -> Array:
    """What cameras of a rig could know of points, each camera's covariance included.

    A pixel of camera c is off by its own noise and by what a small motion of the camera, in its own frame, does to the
    point: S_c = sigma^2 I + J_c C_c J_c^T. Poses of different cameras count as independent.

    Args:
        cameras: placed cameras; a camera without covariance counts as known.
        points: (N, 3) world.
        sigma_px: standard deviation of a pixel coordinate.

    Returns:
        (N, 3, 3) square metres; infinite where fewer than two cameras see the point, or their rays are parallel.
    """
    points = np.asarray(points, float).reshape(-1, 3)
    information, views = np.zeros((len(points), 3, 3)), np.zeros(len(points), int)
    for camera in cameras:
        seen, J, S = pixel_covariances(camera, points, sigma_px)
        information[seen] += np.swapaxes(J, 1, 2) @ np.linalg.solve(S, J)
        views[seen] += 1
    covariance = np.full((len(points), 3, 3), np.inf)
    spread = np.linalg.eigvalsh(information)
    known = (views >= 2) & (spread[:, 0] > 1e-9 * spread[:, 2])
    covariance[known] = np.linalg.inv(information[known])
    return covariance


def pixel_covariances(
    camera: Camera, points: Array, sigma_px: float
) -> tuple[NDArray[np.bool_], Array, Array]:
    """Which of the points (N, 3) a camera sees; of those, J (n, 2, 3) of the pixel by the point, in the world, and the
    covariance (n, 2, 2) of the pixel, by its noise and the camera's pose."""
    T = camera.matrix()
    local = transform(invert(T), points)
    uv, J = camera.project_with_jacobian(local)
    seen = camera.sees(uv)
    local, J = local[seen], J[seen]
    S = np.tile(sigma_px**2 * np.eye(2), (len(J), 1, 1))
    if camera.covariance is not None:
        # A turn w and a shift t of the camera in its own frame move the point there by p x w - t.
        by_pose = np.concatenate([np.cross(J, local[:, None, :]), -J], axis=2)
        S = S + by_pose @ np.array(camera.covariance) @ np.swapaxes(by_pose, 1, 2)
    return seen, J @ T[:3, :3].T, S
