# SPDX-License-Identifier: BSD-3-Clause
"""Linearizes the wand's bundle adjustment around a state, all observations in one NumPy batch.

Every observation depends on one camera and on the two knots around its time. The observations of one camera between
two knots are a `view`: the rows of one factor on (knot, next knot, camera).
See docs/design/wand_adjustment.md.
"""

from dataclasses import dataclass

import numpy as np

from calib.rig.camera import LENS, PER_CAMERA, pixel_jacobians
from calib.wand.bundle_adjustment.eliminated_points import PointInformation, eliminate_points
from calib.wand.bundle_adjustment.problem import Problem, State, WandObservations
from calib.wand.bundle_adjustment.residuals import (
    LENGTH_SIGMA_M,
    SPEED_SIGMA,
    CameraPrior,
    MarkerMotion,
    Weights,
    camera_priors,
    motion_errors,
    predict_markers,
)
from camera_node.foundation.arrays import Array, Index

STEP_SIGMA_M = 0.5  # of a position's change in one step: damps positions that too few cameras observe


@dataclass(frozen=True, slots=True)
class LinearSystem:
    """The linear least-squares system for a step from a state.

    Attributes:
        problem: that was linearized.
        views: (V,) interval between knots times C plus camera, ascending.
        rows: (2n, m) sorted by view: whitened derivatives by the first knot (6 B), the next knot (6 B) and the
            camera's free parameters (d), and the whitened residual.
        bounds: (V + 1,) the first row of each view, and the number of rows.
        chain: (L, 12 B + 1, 12 B + 1) augmented Hessians of the motion terms, by interval: knot k's own terms are in
            interval k, the last knot's in the last interval.
        motion_prior: (L, 12 B + 1, 12 B + 1) the part of `chain` from the prior of the motion: constant velocity and
            zero speed.
        priors: of the cameras.
        background: information of the background points on the cameras.
    """

    problem: Problem
    views: Index
    rows: Array
    bounds: Index
    chain: Array
    motion_prior: Array
    priors: list[CameraPrior]
    background: PointInformation


def linearize(
    problem: Problem, observations: WandObservations, state: State, weights: Weights
) -> LinearSystem:
    """Linearize all residuals around a state."""
    motion = predict_markers(problem, observations, state)
    error, J_camera, J_point = reprojection_jacobians(problem, observations, state, motion)
    root = np.sqrt(weights.observation)[:, None, None] * weights.pixel
    of_basis = problem.wand.weights[observations.label]
    by_basis = (motion.hermite[:, :, None] * of_basis[:, None]).reshape(len(error), 1, -1, 1)
    J_knots = (by_basis * (root @ J_point)[:, :, None]).reshape(len(error), 2, -1)
    rows = np.concatenate([J_knots, root @ J_camera, root @ error[:, :, None]], axis=2)
    view = motion.location.interval * len(problem.lenses) + observations.camera
    order = np.argsort(view, kind="stable")
    first = np.flatnonzero(np.diff(view[order], prepend=-1))
    motion_prior = _linearize_prior(problem, state, weights)
    return LinearSystem(
        problem,
        views=view[order][first],
        rows=rows[order].reshape(-1, rows.shape[2]),
        bounds=2 * np.append(first, len(view)),
        chain=motion_prior + _linearize_lengths(problem, state),
        motion_prior=motion_prior,
        priors=camera_priors(problem, state),
        background=eliminate_points(problem, state, weights.background),
    )


def reprojection_jacobians(
    problem: Problem, observations: WandObservations, state: State, motion: MarkerMotion
) -> tuple[Array, Array, Array]:
    """Reprojection errors (n, 2), 0 behind the camera, and the derivatives of the predicted pixels by the camera's
    free parameters (n, 2, d) and by the marker's position in the world (n, 2, 3)."""
    points, velocity = motion.points, motion.velocity(problem.knot_s)
    since = observations.t_s - problem.middle_s
    error, J_point = np.zeros((len(observations), 2)), np.zeros((len(observations), 2, 3))
    J_camera = np.zeros((len(observations), 2, PER_CAMERA))
    for c, given in enumerate(problem.lenses):
        rows, T, lens = np.flatnonzero(observations.camera == c), state.cameras[c], state.lens(c, given)
        local = (points[rows] - T[:3, 3]) @ T[:3, :3]
        uv, *parts = pixel_jacobians(lens, local)
        J, J_pose, J_lens = (np.nan_to_num(part) for part in parts)
        error[rows] = np.nan_to_num(observations.uv[rows] - uv)
        J_point[rows] = J @ T[:3, :3].T
        J_camera[rows, :, :6], J_camera[rows, :, LENS[0] :] = J_pose, J_lens
    J_camera[:, :, 6] = (J_point @ velocity[:, :, None])[:, :, 0]
    J_camera[:, :, 7] = J_camera[:, :, 6] * since[:, None]
    J_camera[:, :, 8] = J_camera[:, :, 6] * observations.image_row[:, None]
    return error, J_camera[:, :, list(problem.free)], J_point


def _linearize_prior(problem: Problem, state: State, weights: Weights) -> Array:
    """`LinearSystem.motion_prior`: constant velocity between knots, and zero speed at each."""
    B, K = len(problem.wand.basis), len(state.motion)
    local = 12 * B
    smooth, _, speed = motion_errors(problem, state, weights)
    chain = np.zeros((K - 1, local + 1, local + 1))
    weighted = weights.interval[:, None, None] * weights.motion
    H = np.einsum("lri,lrj->lij", weighted, weights.motion)
    chain[:, :local, :local] = np.kron(H, np.eye(3 * B)[None])
    chain[:, :local, -1] = -np.einsum("lri,lrbx->libx", weighted, smooth).reshape(K - 1, local)
    H, g = np.diag(np.repeat([0.0, SPEED_SIGMA**-2], 3 * B)), np.zeros((K, 2, 3 * B))
    g[:, 1] = -speed.reshape(K, -1) / SPEED_SIGMA
    return _add_to_knots(chain, np.broadcast_to(H, (K, *H.shape)), g.reshape(K, -1))


def _linearize_lengths(problem: Problem, state: State) -> Array:
    """The part of `LinearSystem.chain` from the wand's lengths, and the damping."""
    B, (K, local) = len(problem.wand.basis), (len(state.motion), 12 * len(problem.wand.basis))
    gap = state.motion[:, 0][:, problem.wand.pairs]
    gap = gap[:, :, 0] - gap[:, :, 1]
    length = np.linalg.norm(gap, axis=2)
    J = np.zeros((K, len(problem.wand.pairs), 2, B, 3))
    for e, (i, j) in enumerate(problem.wand.pairs):
        along = gap[:, e] / length[:, e, None] / LENGTH_SIGMA_M
        J[:, e, 0, i], J[:, e, 0, j] = along, -along
    J = J.reshape(K, -1, 6 * B)
    error = (problem.wand.lengths - length) / LENGTH_SIGMA_M
    H = np.swapaxes(J, 1, 2) @ J + np.diag(np.repeat([STEP_SIGMA_M**-2, 0.0], 3 * B))
    return _add_to_knots(np.zeros((K - 1, local + 1, local + 1)), H, np.einsum("kri,kr->ki", J, error))


def _add_to_knots(chain: Array, H: Array, g: Array) -> Array:
    """Add Hessians (K, 6 B, 6 B) and gradients (K, 6 B) of the knots to a `chain`."""
    half = g.shape[1]
    for knots, intervals, at in ((slice(0, -1), slice(None), 0), (slice(-1, None), slice(-1, None), half)):
        chain[intervals, at : at + half, at : at + half] += H[knots]
        chain[intervals, at : at + half, -1] += g[knots]
    return chain
