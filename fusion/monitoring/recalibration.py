# SPDX-License-Identifier: BSD-3-Clause
"""Recalibrates the pose of a moved camera from markers whose positions other cameras determine.

1. The image shift on which most pairs of expected and detected roundels agree gives first correspondences.
2. Gauss-Newton on the pose of the camera, with Cauchy weights, alternates with new correspondences in smaller gates.

The other cameras, and with them the world frame, do not change.
"""

from collections.abc import Iterable
from dataclasses import dataclass

import msgspec
import numpy as np
from numpy.typing import NDArray

from calib.rig.camera import Camera, pixel_jacobians
from camera_node.foundation.arrays import Array
from camera_node.geometry.pose import Pose, rotation_from_vector
from fusion.model.frames import CalibratedFrame

SEARCH_PX = 120.0  # largest image shift: 8 degrees at a focal length of 840 px
BIN_PX = 6.0
GATES_PX = (12.0, 6.0, 4.0, 3.0, 3.0, 3.0)
ITERATIONS = 8
MIN_SHARE = 1 / 3  # of the expected markers with a correspondence
MAX_RESIDUAL_PX = 1.2  # median, of an accepted pose
MAX_SIGMA_M, MAX_SIGMA_RAD = 0.008, 0.004  # of an accepted pose, for residuals of NOMINAL_PX
NOMINAL_PX = 0.5


@dataclass(frozen=True, slots=True, eq=False)
class ExpectedFrame:
    """A frame, and points (3, N), world frame, that project to the expected centres of outlines."""

    frame: CalibratedFrame
    points: Array


def recalibrate(camera: Camera, views: list[ExpectedFrame]) -> Camera | None:
    """The camera with its present pose, or None where the views do not determine it.

    Args:
        camera: with its pose before the move.
        views: frames after the move; which detection belongs to which point is unknown.
    """
    points = np.concatenate([view.points for view in views], axis=1).T
    of_view = np.repeat(np.arange(len(views)), [view.points.shape[1] for view in views])
    expected = (camera.project_world(view.points.T) for view in views)
    shift = image_shift(expected, (view.frame.roundels.uv for view in views))
    T, residual_px, covariance = camera.matrix(), np.inf, np.eye(6)
    for gate in GATES_PX:
        uv = _with_pose(camera, T).project_world(points) + shift
        rows, measured = _correspondences(views, uv, of_view, gate)
        if len(rows) < len(points) * MIN_SHARE:
            return None
        T, residual_px, covariance = _fit_pose(camera, T, points[rows], measured)
        shift = np.zeros(2)
    sigma = NOMINAL_PX * np.sqrt(np.diag(covariance))
    if residual_px > MAX_RESIDUAL_PX or max(sigma[3:]) > MAX_SIGMA_M or max(sigma[:3]) > MAX_SIGMA_RAD:
        return None
    return _with_pose(camera, T)


def residual_px(camera: Camera, views: list[ExpectedFrame]) -> float:
    """The median distance from an expected marker to the nearest detection of its view; infinite without views."""
    distances = [
        np.linalg.norm(
            camera.project_world(view.points.T)[:, None] - view.frame.roundels.uv[None], axis=2
        ).min(1, initial=np.inf)
        for view in views
    ]
    return float(np.median(np.concatenate(distances))) if distances else np.inf


def _with_pose(camera: Camera, T: Array) -> Camera:
    return msgspec.structs.replace(camera, T_world_cam=Pose.from_matrix(T))


def image_shift(expected: Iterable[Array], detected: Iterable[Array]) -> Array:
    """(2,) the image shift on which most pairs of expected and detected roundels agree, pixels.

    Args:
        expected, detected: (N, 2) and (M, 2) of each frame of a camera, pixels.
    """
    size = int(SEARCH_PX / BIN_PX)
    votes = np.zeros((2 * size + 1, 2 * size + 1))
    pairs = zip(expected, detected, strict=True)
    off = np.concatenate([(there[None] - uv[:, None]).reshape(-1, 2) for uv, there in pairs])
    off = off[(np.abs(off) < SEARCH_PX).all(1)]
    np.add.at(votes, tuple(np.round(off / BIN_PX).astype(int).T + size), 1)
    smooth = sum(np.roll(votes, (i, j), (0, 1)) for i in (-1, 0, 1) for j in (-1, 0, 1))
    best = (np.array(np.unravel_index(np.argmax(smooth), votes.shape)) - size) * BIN_PX
    near = off[np.linalg.norm(off - best, axis=1) < 2 * BIN_PX]
    return np.median(near, axis=0) if len(near) else np.zeros(2)


def _correspondences(
    views: list[ExpectedFrame], uv: Array, of_view: NDArray, gate_px: float
) -> tuple[NDArray, Array]:
    """Rows of `uv` (N, 2) with a detection of their view within the gate, and the closest detections (K, 2)."""
    rows, found = [], []
    for k, view in enumerate(views):
        expected = np.flatnonzero(of_view == k)
        off = np.linalg.norm(uv[expected, None] - view.frame.roundels.uv[None], axis=2)
        if off.shape[1] and len(expected):
            best = off.argmin(1)
            within = off[np.arange(len(expected)), best] < gate_px
            rows.append(expected[within])
            found.append(view.frame.roundels.uv[best[within]])
    return np.concatenate([np.empty(0, int), *rows]), np.concatenate([np.empty((0, 2)), *found])


def _fit_pose(camera: Camera, T: Array, points: Array, measured: Array) -> tuple[Array, float, Array]:
    """Fit T_world_cam (4, 4) to the centres (N, 2) of points (N, 3), by Gauss-Newton from `T`.

    Returns:
        T, the median residual in pixels, and the covariance (6, 6) for residuals of 1 px. The tangent is rotation,
        then translation, camera frame.
    """
    for _ in range(ITERATIONS):
        H, right, _ = _normal_equations(camera, T, points, measured)
        step = np.linalg.solve(H, right)
        T = T.copy()
        T[:3, 3] += T[:3, :3] @ step[3:]
        T[:3, :3] = T[:3, :3] @ rotation_from_vector(step[:3])
    H, _, residual_px = _normal_equations(camera, T, points, measured)
    return T, residual_px, np.asarray(np.linalg.inv(H), float)


def _normal_equations(camera: Camera, T: Array, points: Array, measured: Array) -> tuple[Array, Array, float]:
    """(6, 6) information and (6,) right side with Cauchy weights, and the median residual in pixels."""
    A, b = _linearize(camera, T, points, measured)
    square = np.sum(b**2, 1)
    weighted = A / (1 + square)[:, None, None]
    H = np.einsum("nai,naj->ij", weighted, A) + 1e-9 * np.eye(6)
    return H, np.einsum("nai,na->i", weighted, b), float(np.sqrt(np.median(square)))


def _linearize(camera: Camera, T: Array, points: Array, measured: Array) -> tuple[Array, Array]:
    """A (K, 2, 6) and b (K, 2) of A xi = b for the visible points."""
    p = (points - T[:3, 3]) @ T[:3, :3]
    uv, _, J_pose, _ = pixel_jacobians(camera, p)
    known = np.isfinite(uv).all(1)
    return J_pose[known], (measured - uv)[known]
