# SPDX-License-Identifier: BSD-3-Clause
"""The wand's lengths as the cameras measure them."""

import numpy as np

from calib.wand.bundle_adjustment.optimizer import Adjusted
from calib.wand.bundle_adjustment.problem import WandObservations
from camera_node.arrays import Array, Index


def free_markers(adjusted: Adjusted, seen: WandObservations) -> Array:
    """(K, M, 3) where the cameras alone put the wand's markers; NaN where fewer than two saw one.

    Every marker of an instant moves, in one Gauss-Newton step that knows no length, to where its observations want it.
    """
    state, problem = adjusted.state, adjusted.problem
    markers = np.einsum("mb,kbx->kmx", problem.wand.weights, state.motion[:, 0])
    A, b = np.zeros((*markers.shape, 3)), np.zeros(markers.shape)
    views = np.zeros((*markers.shape[:2], len(problem.lenses)))
    for c, lens in enumerate(problem.lenses):
        rows, T = np.flatnonzero((seen.camera == c) & adjusted.used), state.cameras[c]
        k, m = seen.knot[rows], seen.label[rows]
        local = (markers[k, m] - T[:3, 3]) @ T[:3, :3]
        J = np.nan_to_num(state.lens(c, lens).project_with_jacobian(local)[1]) @ T[:3, :3].T
        weight = np.linalg.inv(seen.cov[rows])
        np.add.at(A, (k, m), np.swapaxes(J, 1, 2) @ weight @ J)
        np.add.at(b, (k, m), np.einsum("nji,njk,nk->ni", J, weight, np.nan_to_num(adjusted.residuals[rows])))
        views[k, m, c] = 1
    fixed = views.sum(axis=2) >= 2
    free = np.full(markers.shape, np.nan)
    free[fixed] = markers[fixed] + np.linalg.solve(A[fixed], b[fixed][:, :, None])[:, :, 0]
    return free


def measure_lengths(adjusted: Adjusted, seen: WandObservations) -> Array:
    """(n,) what the cameras alone say of the wand's lengths, less what they are; metres."""
    wand = adjusted.problem.wand
    errors = distances(free_markers(adjusted, seen)[:, wand.basis], wand.pairs) - wand.lengths
    return errors[np.isfinite(errors)]


def distances(points: Array, pairs: Index) -> Array:
    """(K, P) distances of P pairs of points (K, N, 3)."""
    ends = points[:, pairs]
    return np.asarray(np.linalg.norm(ends[:, :, 0] - ends[:, :, 1], axis=2), float)
