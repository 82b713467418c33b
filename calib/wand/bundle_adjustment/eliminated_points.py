# SPDX-License-Identifier: BSD-3-Clause
"""Background points in the adjustment: eliminated, so that they constrain the cameras only.

Positions are optimal for the cameras of every state (variable projection: Golub and Pereyra 1973). With J the whitened
derivatives of a point's pixels by its position and N an orthonormal basis of the null space of J^T, the rows of its
pixels times N^T depend on the cameras alone (Mourikis and Roumeliotis 2007, section III-D).
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from calib.rig.camera import LENS, PER_CAMERA, pixel_jacobians
from calib.wand.background import BackgroundPoints
from calib.wand.bundle_adjustment.problem import Problem, State
from calib.wand.tracks import intersect
from camera_node.foundation.arrays import Array, Index, Mask

BEHIND = 1e4  # sigmas: the residual of a point behind its camera
STEPS = 3  # of Gauss-Newton: a point moves little while its cameras take one step
ROBUST_STEPS = 10
CAUCHY_SCALE = 2.3849  # sigmas: 95 % efficient on normal residuals
# Relative information that is added to every coordinate: a point on parallel rays stays where it is.
REGULAR = 1e-9


@dataclass(frozen=True, slots=True)
class PointInformation:
    """Information of all background points on the cameras' d free parameters, the points eliminated.

    Attributes:
        information: (C, d, C, d).
        scores: (J, C, d) gradients by point.
    """

    information: Array
    scores: Array


def start_points(problem: Problem, state: State, background: BackgroundPoints) -> tuple[Problem, State]:
    """The problem with those background points that a state's cameras locate, and the state with their positions."""
    points = _nearest_to_rays(problem, state, background)
    known = np.asarray(np.isfinite(points).all(axis=1))
    rows = np.flatnonzero(known[background.point])
    problem = replace(problem, background=background.select(rows))
    return problem, locate_robustly(problem, replace(state, points=points[known]))


def locate(problem: Problem, state: State, used: Mask) -> State:
    """The state with points that are optimal for its cameras, by Gauss-Newton from its own, from the images `used`."""
    for _ in range(STEPS if len(state.points) else 0):
        state = _step(problem, state, used.astype(float))
    return state


def locate_robustly(problem: Problem, state: State) -> State:
    """The same from all images, with Cauchy's weights at a scale that the residuals give."""
    for _ in range(ROBUST_STEPS if len(state.points) else 0):
        norms = point_error_norms(problem, state)
        scale = CAUCHY_SCALE * max(float(np.median(norms)) / 1.1774, 1.0)
        state = _step(problem, state, 1 / (1 + (norms / scale) ** 2))
    return state


def point_error_norms(problem: Problem, state: State) -> Array:
    """(n,) norms of the whitened reprojection errors of all images."""
    return np.linalg.norm(_linearize(problem, state)[0], axis=1)


def point_residuals(problem: Problem, state: State) -> Array:
    """(n, 2) reprojection errors of all images, pixels; NaN behind the camera."""
    background, errors = problem.background, np.empty_like(problem.background.uv)
    for c, lens in enumerate(problem.lenses):
        rows, T = background.camera == c, state.cameras[c]
        local = (state.points[background.point[rows]] - T[:3, 3]) @ T[:3, :3]
        errors[rows] = background.uv[rows] - state.lens(c, lens).project(local)
    return errors


def accept(problem: Problem, norms: Array, limit: float) -> Mask:
    """(n,) images whose errors are below `limit` sigmas, of points that have two or more of these."""
    accepted = norms < limit
    count = np.bincount(problem.background.point[accepted], minlength=len(problem.background))
    return accepted & (count >= 2)[problem.background.point]


def eliminate_points(problem: Problem, state: State, used: Mask) -> PointInformation:
    """Eliminate the points from the images `used` (n,)."""
    C, d = len(problem.lenses), len(problem.free)
    H, scores = np.zeros((C, d, C, d)), np.zeros((len(problem.background), C, d))
    if not used.any():
        return PointInformation(H, scores)
    error, J_camera, J_point = _linearize(problem, state)
    for rows, points in _groups(problem.background, used):
        cameras, (m, n) = problem.background.camera[rows[0]], rows.shape
        free = np.linalg.qr(J_point[rows].reshape(m, 2 * n, 3), mode="complete").Q[:, :, 3:]
        apart = np.zeros((m, n, 2, n, d))
        apart[:, range(n), :, range(n)] = np.swapaxes(J_camera[rows], 0, 1)
        J = np.swapaxes(free, 1, 2) @ apart.reshape(m, 2 * n, n * d)
        residual = np.swapaxes(free, 1, 2) @ error[rows].reshape(m, 2 * n, 1)
        G = np.einsum("mri,mrj->ij", J, J, optimize=True).reshape(n, d, n, d)
        H[np.ix_(cameras, np.arange(d), cameras, np.arange(d))] += G
        scores[points[:, None], cameras] = (np.swapaxes(J, 1, 2) @ residual).reshape(m, n, d)
    return PointInformation(H, scores)


def _groups(background: BackgroundPoints, used: Mask) -> Iterator[tuple[Index, Index]]:
    """The rows (m, n) of all m points that the same n cameras see, and the points (m,)."""
    rows = np.flatnonzero(used)
    point = background.point[rows]
    seen = np.zeros((len(background), int(background.camera.max()) + 1), bool)
    seen[point, background.camera[rows]] = True
    patterns, of_point = np.unique(seen, axis=0, return_inverse=True)
    for k, pattern in enumerate(patterns):
        if (n := int(pattern.sum())) >= 2:
            yield rows[of_point[point] == k].reshape(-1, n), np.flatnonzero(of_point == k)


def _linearize(problem: Problem, state: State) -> tuple[Array, Array, Array]:
    """Whitened errors (n, 2) of all images, observed less predicted, and the derivatives of the predicted ones by the
    camera's free parameters (n, 2, d) and by the point (n, 2, 3), 0 behind the camera."""
    background = problem.background
    n, points = len(background.uv), state.points[background.point]
    error, J_point, J_camera = np.empty((n, 2)), np.empty((n, 2, 3)), np.zeros((n, 2, PER_CAMERA))
    for c, given in enumerate(problem.lenses):
        rows, T = np.flatnonzero(background.camera == c), state.cameras[c]
        uv, J, J_pose, J_lens = pixel_jacobians(state.lens(c, given), (points[rows] - T[:3, 3]) @ T[:3, :3])
        error[rows], J_point[rows] = background.uv[rows] - uv, J @ T[:3, :3].T
        J_camera[rows, :, :6], J_camera[rows, :, LENS[0] :] = J_pose, J_lens
    root = np.linalg.inv(np.linalg.cholesky(background.cov))
    errors = np.nan_to_num((root @ error[:, :, None])[:, :, 0], nan=BEHIND)
    J_camera = J_camera[:, :, list(problem.free)]
    return errors, np.nan_to_num(root @ J_camera), np.nan_to_num(root @ J_point)


def _step(problem: Problem, state: State, weight: Array) -> State:
    """One step of Gauss-Newton for all points, with weights (n,) of the images."""
    error, _, J = _linearize(problem, state)
    n, point = len(state.points), problem.background.point
    H, g = np.zeros((n, 3, 3)), np.zeros((n, 3))
    np.add.at(H, point, weight[:, None, None] * np.swapaxes(J, 1, 2) @ J)
    np.add.at(g, point, weight[:, None] * (np.swapaxes(J, 1, 2) @ error[:, :, None])[:, :, 0])
    regular = REGULAR * np.einsum("jii->j", H)[:, None, None] + np.finfo(float).tiny
    step = np.linalg.solve(H + regular * np.eye(3), g[:, :, None])[:, :, 0]
    return replace(state, points=state.points + step)


def _nearest_to_rays(problem: Problem, state: State, background: BackgroundPoints) -> Array:
    """(J, 3) the points nearest to their rays, robustly; NaN where these are nearly parallel."""
    count, C = len(background), len(problem.lenses)
    rays, known = np.zeros((C, 1, count, 3)), np.zeros((C, 1, count), bool)
    for c, given in enumerate(problem.lenses):
        rows = background.camera == c
        ray = state.lens(c, given).rays(background.uv[rows]) @ state.cameras[c, :3, :3].T
        known[c, 0, background.point[rows]] = np.isfinite(ray).all(axis=1)
        rays[c, 0, background.point[rows]] = np.nan_to_num(ray)
    return intersect(rays, state.cameras[:, :3, 3], known)[0][0]
