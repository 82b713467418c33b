# SPDX-License-Identifier: BSD-3-Clause
"""The cameras' part of a wand's linear system, its motion eliminated (Schur complement).

The motion is a chain, so its Hessian is banded and one Cholesky factorisation eliminates it for all cameras at once.
"""

from dataclasses import dataclass

import numpy as np

from calib.wand.bundle_adjustment.linear_system import Linearisation
from camera_node.arrays import Array


@dataclass(frozen=True, slots=True)
class Marginal:
    """Of the S sought cameras' d free parameters: `information` (S d, S d), and `scores` (L, S d), the gradients of
    each interval's observations and motion, without what is known of the cameras."""

    information: Array
    scores: Array


def marginalise(linear: Linearisation) -> Marginal:
    """Eliminate the motion: where it follows the cameras by G = H_mm^-1 H_mc, the information is H_cc - H_cm G, and an
    interval's score J_c^T r - G^T J_m^T r."""
    local, links = 12 * len(linear.problem.wand.basis), len(linear.chain)
    sought, d = list(linear.problem.cameras()), len(linear.problem.free)
    slot = np.full(len(linear.problem.lenses), -1)
    slot[sought] = np.arange(len(sought))
    hessian, gradient = linear.chain[:, :local, :local].copy(), linear.chain[:, :local, -1].copy()
    crossed, scores = np.zeros((links, local, len(sought), d)), np.zeros((links, len(sought), d))
    own = known(linear)
    for link, camera, N in _normal_equations(linear):
        first = np.flatnonzero(np.diff(link, prepend=-1))
        hessian[link[first]] += np.add.reduceat(N[:, :local, :local], first)
        gradient[link[first]] += np.add.reduceat(N[:, :local, -1], first)
        mine = slot[camera] >= 0
        link, camera, N = link[mine], slot[camera[mine]], N[mine, :, local:]
        crossed[link, :, camera] = N[:, :local, :-1]
        scores[link, camera] = N[:, local:-1, -1]
        for k in range(len(sought)):
            own[k, :, k] += N[camera == k, local:-1, :-1].sum(axis=0)
    crossed = crossed.reshape(links, local, -1)
    joined, follow = _join(crossed), _solve_chain(hessian, _join(crossed))
    information = own.reshape(len(sought) * d, -1) - joined.T @ follow
    followed = follow.reshape(links + 1, local // 2, -1)
    pulled = gradient.reshape(links, 2, 1, -1) @ np.stack([followed[:-1], followed[1:]], axis=1)
    return Marginal(information, scores.reshape(links, -1) - pulled.sum(axis=1)[:, 0])


def known(linear: Linearisation) -> Array:
    """(S, d, S, d) information of what is known of the sought cameras beside what they saw."""
    sought, d = list(linear.problem.cameras()), len(linear.problem.free)
    H = np.zeros((len(sought), d, len(sought), d))
    for cameras, J, _ in linear.rig:
        if set(cameras) <= set(sought):
            for a, J_a in zip(cameras, J, strict=True):
                for b, J_b in zip(cameras, J, strict=True):
                    H[sought.index(a), :, sought.index(b)] += J_a.T @ J_b
    return H


def _normal_equations(linear: Linearisation):
    """Intervals, ascending, cameras and augmented Hessians (v, m, m) of all views of as many rows."""
    link, camera = np.divmod(linear.views, len(linear.problem.lenses))
    size = np.diff(linear.ends)
    for n in np.unique(size).tolist():
        views = np.flatnonzero(size == n)
        rows = linear.rows[linear.ends[views, None] + np.arange(n)]
        yield link[views], camera[views], np.swapaxes(rows, 1, 2) @ rows


def _join(parts: Array) -> Array:
    """(K h, n) the sum of the parts (L, 2 h, n) of a chain, each of which shares the second half of its rows with the
    first half of the next."""
    links, local, columns = parts.shape
    joined = np.zeros((links + 1, local // 2, columns))
    joined[:-1] += parts[:, : local // 2]
    joined[1:] += parts[:, local // 2 :]
    return joined.reshape(-1, columns)


def _solve_chain(hessian: Array, right: Array) -> Array:
    """(K h, n) the solution of a chain of overlapping Hessians (L, 2 h, 2 h) for right-hand sides (K h, n)."""
    from scipy.linalg import solveh_banded

    links, local = hessian.shape[:2]
    half, banded = local // 2, np.zeros((local, len(right)))
    for a in range(local):
        for b in range(a + 1):
            banded[a - b, b : b + links * half : half] += hessian[:, a, b]
    return np.asarray(solveh_banded(banded, right, lower=True), float)
