# SPDX-License-Identifier: BSD-3-Clause
"""Triangulates points that several placed cameras see, and predicts the covariance of such points."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from calib.errors import CalibrationError
from calib.rig.camera import LENS, OFFSET, POSE, Camera, pixel_jacobians, transform
from calib.rig.camera_errors import PARAMETERS, error_covariance
from camera_node.foundation.arrays import Array, Mask
from camera_node.geometry.lens import Lens
from camera_node.geometry.pose import invert

Visibility = Callable[[Camera, Array], Mask]

MIN_ANGLE = 0.01  # rad between viewing rays, about: rays that are closer to parallel fix no point
ITERATIONS, CONVERGED_M = 8, 1e-10
REWEIGHTINGS = 8  # of many rays at once
RAY_ANGLE = 0.003  # scale of Cauchy's weights of these: angle between a ray and the point, radians
MIN_INFORMATION_RATIO = 1e-4  # along the worst and the best axis, below which these rays are parallel


def triangulate_point(cameras: Sequence[Camera], uv: ArrayLike) -> Array:
    """Locate one point seen by several cameras.

    Starts at the point nearest to all viewing rays, then minimizes the squared reprojection error by Gauss-Newton.

    Args:
        cameras: the N >= 2 placed cameras that saw the point.
        uv: (N, 2) raw pixels, one row per camera.

    Returns:
        (3,) world, metres.

    Raises:
        CalibrationError: the rays are too close to parallel to fix a point, or they meet behind the cameras.
    """
    p = triangulate_points(cameras, np.asarray(uv, float)[:, None])[0]
    if not np.isfinite(p).all():
        raise CalibrationError(
            "the viewing rays are too close to parallel to fix a point, or they meet behind the cameras"
        )
    return p


def triangulate_points(cameras: Sequence[Camera], uv: Array) -> Array:
    """Locate points as `triangulate_point`, all at once.

    Args:
        cameras: C placed cameras.
        uv: (C, N, 2) raw pixels; NaN where a camera did not see a point.

    Returns:
        (N, 3) world, metres; NaN where the rays do not fix a point, or meet behind the cameras.
    """
    p = _nearest_to_rays(cameras, uv)
    moving = np.flatnonzero(np.isfinite(p).all(axis=1))
    for _ in range(ITERATIONS):
        A, b = np.zeros((len(moving), 3, 3)), np.zeros((len(moving), 3))
        for camera, pixels in zip(cameras, uv[:, moving], strict=True):
            seen, T = np.isfinite(pixels).all(axis=1), camera.matrix()
            predicted, J = camera.project_with_jacobian(transform(invert(T), p[moving[seen]]))
            J = J @ T[:3, :3].T
            A[seen] += J.mT @ J
            b[seen] += np.einsum("nki,nk->ni", J, pixels[seen] - predicted)
        # A point that runs away between nearly parallel rays has no solution; one behind a camera has no image.
        spread = np.linalg.eigvalsh(np.nan_to_num(A))
        fixed = np.isfinite(A).all(axis=(1, 2)) & (spread[:, 0] > np.finfo(float).eps * spread[:, 2])
        p[moving[~fixed]] = np.nan
        moving, A, b = moving[fixed], A[fixed], b[fixed]
        step = np.linalg.solve(A, b[:, :, None])[:, :, 0]
        p[moving] += step
        moving = moving[np.abs(step).max(axis=1) >= CONVERGED_M]
        if not len(moving):
            break
    return p


def intersect(ray: Array, centre: Array, known: Mask, rounds: int = REWEIGHTINGS) -> tuple[Array, Array]:
    """Return points (M, K, 3) nearest to `known` (C, M, K) rays (C, M, K, 3) through centres (C, 3), and the rays'
    angles (C, M, K) to them; points are NaN where fewer than two rays are known, or they are nearly parallel.
    The first of the rounds weighs all rays alike."""
    across = np.eye(3) - ray[..., :, None] * ray[..., None, :]
    toward = np.einsum("cmkij,cj->cmki", across, centre)
    weight = known.astype(float)
    points, angle = np.full((*known.shape[1:], 3), np.nan), np.zeros(known.shape)
    for _ in range(rounds):
        A, b = np.einsum("cmk,cmkij->mkij", weight, across), np.einsum("cmk,cmki->mki", weight, toward)
        spread = np.linalg.eigvalsh(A)
        solvable = (known.sum(axis=0) >= 2) & (spread[..., 0] > MIN_INFORMATION_RATIO * spread[..., 2])
        points[:] = np.nan
        points[solvable] = np.linalg.solve(A[solvable], b[solvable][:, :, None])[:, :, 0]
        away = np.nan_to_num(points) - centre[:, None, None]
        angle = np.linalg.norm(np.einsum("cmkij,cmkj->cmki", across, away), axis=3)
        angle /= np.maximum(np.linalg.norm(away, axis=3), 1e-9)
        weight = known / (angle**2 + RAY_ANGLE**2) * RAY_ANGLE**2
    return points, angle


def intersect_images(xy: Array, poses: Array, rounds: int = REWEIGHTINGS) -> tuple[Array, Array, Mask]:
    """As `intersect`, of image plane coordinates (C, M, K, 2), NaN where unknown, of cameras with poses (C, 4, 4); and
    which (C, M, K) are known."""
    known = np.isfinite(xy[..., 0])
    ray = np.concatenate([np.nan_to_num(xy), np.ones((*known.shape, 1))], axis=3)
    ray = np.einsum("cij,cmkj->cmki", poses[:, :3, :3], ray / np.linalg.norm(ray, axis=3, keepdims=True))
    return *intersect(ray, poses[:, :3, 3], known, rounds), known


def _nearest_to_rays(cameras: Sequence[Camera], uv: Array) -> Array:
    """(N, 3) points nearest to the rays of pixels (C, N, 2); NaN where these are nearly parallel."""
    T = np.array([camera.matrix() for camera in cameras]).reshape(-1, 4, 4)
    pairs = zip(cameras, np.nan_to_num(uv), T[:, :3, :3], strict=True)
    rays = np.array([camera.rays(pixels) @ R.T for camera, pixels, R in pairs])[:, None]
    seen = np.asarray(np.isfinite(uv).all(axis=2))[:, None]
    known = seen & np.asarray(np.isfinite(rays).all(axis=3))
    return intersect(np.nan_to_num(rays), T[:, :3, 3], known, rounds=1)[0][0]


@dataclass(frozen=True, slots=True)
class JointCovariance:
    """Covariance (C d, C d) of C cameras together: of d `parameters` each, numbered as in `calib.rig.camera`."""

    parameters: tuple[int, ...]
    covariance: Array

    @classmethod
    def stated(cls, cameras: Sequence[Camera]) -> "JointCovariance":
        """What the cameras state of their errors; 0 for a camera that states none."""
        return cls(PARAMETERS, error_covariance(cameras, unstated_px=0.0))


def in_image(camera: Camera, points: Array) -> Mask:
    """(N,) whether points (N, 3), world, lie in the image of a camera."""
    return camera.sees(camera.project_world(points))


def point_covariances(
    cameras: Sequence[Camera],
    points: ArrayLike,
    sigma_px: float,
    joint: JointCovariance | None = None,
    sees: Visibility = in_image,
) -> Array:
    """Predict the covariance of points that these cameras triangulate: from pixel noise and from calibration errors.

    Tracking treats the cameras as exact, and so does the least squares estimate here: with A = sum J^T J / sigma^2,
    pixel noise contributes A^-1, and errors xi of the cameras move the point by A^-1 G xi, with
    G = sum J^T (dpixel / dxi) / sigma^2.

    Args:
        cameras: C placed cameras; a camera without covariance counts as exact.
        points: (N, 3) world, metres.
        sigma_px: standard deviation of one pixel coordinate.
        joint: covariance of all cameras together; by default what they state.
        sees: the visibility test, which returns (N,) whether a camera sees each point.

    Returns:
        (N, 3, 3) square metres; infinite where fewer than two cameras see the point, or their rays are parallel.
    """
    points = np.asarray(points, float).reshape(-1, 3)
    joint = joint or JointCovariance.stated(cameras)
    seen = np.array([sees(camera, points) for camera in cameras], bool).reshape(len(cameras), len(points))
    known, inverse, by_camera = point_derivatives(cameras, points, sigma_px, joint.parameters, seen)
    covariance = np.full((len(points), 3, 3), np.inf)
    covariance[known] = inverse + by_camera @ joint.covariance @ np.swapaxes(by_camera, 1, 2)
    return covariance


def point_derivatives(
    cameras: Sequence[Camera], points: Array, sigma_px: float, parameters: tuple[int, ...], seen: Mask
) -> tuple[Mask, Array, Array]:
    """How triangulated points depend on their pixels and on errors of the cameras; see `point_covariances`.

    Args:
        cameras: C placed cameras.
        points: (N, 3) world, metres.
        sigma_px: standard deviation of one pixel coordinate.
        parameters: d parameters of each camera, numbered as in `calib.rig.camera`.
        seen: (C, N) which cameras see each point.

    Returns:
        known: (N,) points that two cameras see, with rays that are not parallel; K of them.
        covariance: (K, 3, 3) by pixel noise, square metres.
        by_camera: (K, 3, C d) derivatives of these points by the cameras' parameters.
    """
    A, d = np.zeros((len(points), 3, 3)), len(parameters)
    G = np.zeros((len(points), 3, d * len(cameras)))
    for k, camera in enumerate(cameras):
        J, J_camera = _world_jacobians(camera, points[seen[k]], parameters)
        A[seen[k]] += np.swapaxes(J, 1, 2) @ J / sigma_px**2
        G[seen[k], :, d * k : d * k + d] = np.swapaxes(J, 1, 2) @ J_camera / sigma_px**2
    spread = np.linalg.eigvalsh(A)
    known = (seen.sum(axis=0) >= 2) & (spread[:, 0] > MIN_ANGLE**2 / 100 * spread[:, 2])
    inverse: Array = np.linalg.inv(A[known]).astype(float)
    return known, inverse, inverse @ G[known]


def _world_jacobians(camera: Camera, points: Array, parameters: tuple[int, ...]) -> tuple[Array, Array]:
    """Derivatives of the pixels of points (N, 3), world: by the point (N, 2, 3) and by the camera (N, 2, d)."""
    T = camera.matrix()
    local = transform(invert(T), points)
    J = camera.project_with_jacobian(local)[1]
    return J @ T[:3, :3].T, camera_jacobians(camera, local, parameters)


def camera_jacobians(camera: Lens, points: Array, parameters: tuple[int, ...] = POSE) -> Array:
    """(N, 2, d) derivatives of the pixels of points (N, 3), camera frame, by the camera's `parameters`.

    Parameters are numbered as in `calib.rig.camera`. Times do not move points at rest.
    """
    _, _, J_pose, J_lens = pixel_jacobians(camera, points)
    clock = np.zeros((len(points), 2, LENS[0] - OFFSET[0]))
    return np.concatenate([J_pose, clock, J_lens], axis=2)[:, :, list(parameters)]
