# SPDX-License-Identifier: BSD-3-Clause
"""Eliminates the wand's motion from a linear system (Schur complement), which leaves the cameras' information.

The motion is a chain, so its Hessian is banded, and one Cholesky factorization eliminates it for all cameras at once.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from calib.wand.bundle_adjustment.linear_system import LinearSystem
from camera_node.arrays import Array, Index


@dataclass(frozen=True, slots=True)
class CameraInformation:
    """Information on the d free parameters of the S estimated cameras, the motion eliminated.

    Attributes:
        information: (S d, S d), with the cameras' priors.
        scores: (L + J, S d) gradients by interval between knots, then by background point, without the cameras' priors.
    """

    information: Array
    scores: Array


def eliminate_motion(system: LinearSystem) -> CameraInformation:
    """Eliminate the motion. With G = H_mm^-1 H_mc, the information is H_cc - H_cm G, and the score of an interval is
    J_c^T r - G^T J_m^T r."""
    local, intervals = 12 * len(system.problem.wand.basis), len(system.chain)
    estimated, d = list(system.problem.estimated_cameras()), len(system.problem.free)
    slot = np.full(len(system.problem.lenses), -1)
    slot[estimated] = np.arange(len(estimated))
    hessian, gradient = system.chain[:, :local, :local].copy(), system.chain[:, :local, -1].copy()
    crossed = np.zeros((intervals, local, len(estimated), d))
    scores = np.zeros((intervals, len(estimated), d))
    own = prior_information(system)
    own += system.background.information[np.ix_(estimated, range(d), estimated, range(d))]
    for interval, camera, N in _normal_equations(system):
        first = np.flatnonzero(np.diff(interval, prepend=-1))
        hessian[interval[first]] += np.add.reduceat(N[:, :local, :local], first)
        gradient[interval[first]] += np.add.reduceat(N[:, :local, -1], first)
        mine = slot[camera] >= 0
        interval, camera, N = interval[mine], slot[camera[mine]], N[mine, :, local:]
        crossed[interval, :, camera] = N[:, :local, :-1]
        scores[interval, camera] = N[:, local:-1, -1]
        for k in range(len(estimated)):
            own[k, :, k] += N[camera == k, local:-1, :-1].sum(axis=0)
    joined = _join(crossed.reshape(intervals, local, -1))
    G = _solve_chain(hessian, joined)
    information = own.reshape(len(estimated) * d, -1) - joined.T @ G
    by_knot = G.reshape(intervals + 1, local // 2, -1)
    eliminated = gradient.reshape(intervals, 2, 1, -1) @ np.stack([by_knot[:-1], by_knot[1:]], axis=1)
    of_motion = scores.reshape(intervals, -1) - eliminated.sum(axis=1)[:, 0]
    of_points = system.background.scores[:, estimated].reshape(-1, of_motion.shape[1])
    return CameraInformation(information, np.concatenate([of_motion, of_points]))


def prior_information(system: LinearSystem) -> Array:
    """(S, d, S, d) information of the priors of the estimated cameras."""
    estimated, d = list(system.problem.estimated_cameras()), len(system.problem.free)
    H = np.zeros((len(estimated), d, len(estimated), d))
    for prior in system.priors:
        if set(prior.cameras) <= set(estimated):
            for a, J_a in zip(prior.cameras, prior.jacobians, strict=True):
                for b, J_b in zip(prior.cameras, prior.jacobians, strict=True):
                    H[estimated.index(a), :, estimated.index(b)] += J_a.T @ J_b
    return H


def _normal_equations(system: LinearSystem) -> Iterator[tuple[Index, Index, Array]]:
    """Intervals, ascending, cameras, and augmented Hessians (v, m, m), of all views with the same number of rows."""
    interval, camera = np.divmod(system.views, len(system.problem.lenses))
    size = np.diff(system.bounds)
    for n in np.unique(size).tolist():
        views = np.flatnonzero(size == n)
        rows = system.rows[system.bounds[views, None] + np.arange(n)]
        yield interval[views], camera[views], np.swapaxes(rows, 1, 2) @ rows


def _join(parts: Array) -> Array:
    """(K h, n) sum of the parts (L, 2 h, n) of a chain, each of which shares its last h rows with the next."""
    intervals, local, columns = parts.shape
    joined = np.zeros((intervals + 1, local // 2, columns))
    joined[:-1] += parts[:, : local // 2]
    joined[1:] += parts[:, local // 2 :]
    return joined.reshape(-1, columns)


def _solve_chain(hessian: Array, right: Array) -> Array:
    """(K h, n) solution of a chain of overlapping Hessians (L, 2 h, 2 h) for right-hand sides (K h, n)."""
    from scipy.linalg import solveh_banded

    intervals, local = hessian.shape[:2]
    half, banded = local // 2, np.zeros((local, len(right)))
    for a in range(local):
        for b in range(a + 1):
            banded[a - b, b : b + intervals * half : half] += hessian[:, a, b]
    return np.asarray(solveh_banded(banded, right, lower=True), float)
