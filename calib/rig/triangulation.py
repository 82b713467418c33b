# SPDX-License-Identifier: BSD-3-Clause
"""A point seen by several placed cameras, and how well it is known: by their pixels and by their own poses."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from calib.errors import CalibrationError
from calib.rig.camera import POSE, Camera, pixel_jacobians, transform
from camera_node.arrays import Array, Mask
from camera_node.geometry.lens import Lens
from camera_node.geometry.pose import invert

Sees = Callable[[Camera, Array], Mask]

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


@dataclass(frozen=True, slots=True)
class Joint:
    """Covariance (C d, C d) of d `parameters` of C cameras together, numbered as in `linearisation`."""

    parameters: tuple[int, ...]
    covariance: Array


def in_image(camera: Camera, points: Array) -> Mask:
    """Which of the points (N, 3), world, lie in a camera's image."""
    return camera.sees(camera.project_world(points))


def point_covariances(
    cameras: Sequence[Camera],
    points: ArrayLike,
    sigma_px: float,
    joint: Joint | None = None,
    sees: Sees = in_image,
) -> Array:
    """How well points would be known that all these cameras see, by their pixels and by their own poses.

    Least squares that takes the cameras for exact, as tracking does: with A = sum J^T J / sigma^2, pixel noise leaves
    A^-1, and errors xi of the cameras move the point by A^-1 G xi, G = sum J^T (dpixel / dxi) / sigma^2.

    Args:
        cameras: C placed cameras; a camera without covariance counts as known.
        points: (N, 3) world.
        sigma_px: standard deviation of a pixel coordinate.
        joint: covariance of all cameras together; without it their poses count as independent, and lenses as exact.
        sees: which points a camera sees.

    Returns:
        (N, 3, 3) square metres; infinite where fewer than two cameras see the point, or their rays are parallel.
    """
    points = np.asarray(points, float).reshape(-1, 3)
    A, views = np.zeros((len(points), 3, 3)), np.zeros(len(points), int)
    joint = joint or Joint(POSE, _independent(cameras))
    d = len(joint.parameters)
    G = np.zeros((len(points), 3, d * len(cameras)))
    for k, camera in enumerate(cameras):
        seen = sees(camera, points)
        J, by_camera = _pixel_jacobians(camera, points[seen], joint.parameters)
        A[seen] += np.swapaxes(J, 1, 2) @ J / sigma_px**2
        G[seen, :, d * k : d * k + d] = np.swapaxes(J, 1, 2) @ by_camera / sigma_px**2
        views[seen] += 1
    spread = np.linalg.eigvalsh(A)
    known = (views >= 2) & (spread[:, 0] > MIN_ANGLE**2 / 100 * spread[:, 2])
    inverse = np.linalg.inv(A[known])
    moved = inverse @ G[known]
    covariance = np.full((len(points), 3, 3), np.inf)
    covariance[known] = inverse + moved @ joint.covariance @ np.swapaxes(moved, 1, 2)
    return covariance


def _independent(cameras: Sequence[Camera]) -> Array:
    joint = np.zeros((6 * len(cameras), 6 * len(cameras)))
    for k, camera in enumerate(cameras):
        if camera.covariance is not None:
            joint[6 * k : 6 * k + 6, 6 * k : 6 * k + 6] = camera.covariance
    return joint


def _pixel_jacobians(camera: Camera, points: Array, parameters: tuple[int, ...]) -> tuple[Array, Array]:
    """How the pixels of points (N, 3) change with the point in the world (N, 2, 3), and with the camera (N, 2, d)."""
    T = camera.matrix()
    local = transform(invert(T), points)
    J = camera.project_with_jacobian(local)[1]
    return J @ T[:3, :3].T, camera_jacobians(camera, local, parameters)


def camera_jacobians(camera: Lens, points: Array, parameters: tuple[int, ...] = POSE) -> Array:
    """(N, 2, d) how the pixels of points (N, 3), camera frame, change with the camera's `parameters`.

    They are numbered as in `problem`; time offset and drift leave points at rest where they are.
    """
    _, _, J_pose, J_lens = pixel_jacobians(camera, points)
    still = np.zeros((len(points), 2, 2))
    return np.concatenate([J_pose, still, J_lens], axis=2)[:, :, list(parameters)]
