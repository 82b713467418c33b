# SPDX-License-Identifier: BSD-3-Clause
"""How much less a wave tells than its observations would if their errors were independent.

A lens that its model does not quite fit errs alike wherever the wand is near the same place, for a second or so; a
covariance that counts every frame as news is then too sure. The remedy is the cluster-robust (sandwich) covariance
(Liang and Zeger 1986; Cameron and Miller 2015): with the scores s_b of blocks of time, summed over each block, and the
information H, the estimate's covariance is H^-1 (sum_b s_b s_b^T) H^-1, which is H^-1 where errors are independent. A
minute has too few blocks for all its entries, but enough for one factor, the mean of its eigenvalues over those of
H^-1: on a real recording, it was the same in weak and in strong directions.
"""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from calib.adjustment import BREAK, Adjusted
from calib.linearisation import Linearisation
from calib.problem import Observations

Array = NDArray[np.float64]

BLOCK_S = 1.0  # longer than the wand stays in one place
FEWEST = 4  # blocks: of fewer, nothing is concluded


def widen(adjusted: Adjusted, observations: Observations) -> Adjusted:
    """The adjustment with covariances widened by what its residuals' dependence asks for."""
    factor = dependence(adjusted, observations)
    return replace(adjusted, dependence=factor)


def dependence(adjusted: Adjusted, observations: Observations) -> float:
    """By what to multiply covariances, 1 or more. Below 1 it never is: the motion that is fitted takes up errors."""
    problem, state = adjusted.problem, adjusted.state
    kept = observations.select(adjusted.used)
    linear = Linearisation(problem, kept)
    linear.weigh(state)
    whole = linear.errors(state).strain <= BREAK
    linear.relinearise(state, np.ones(len(kept)), whole.astype(float))
    scores = _block_scores(linear)
    if len(scores) < FEWEST:
        return 1.0
    # At the optimum scores sum to what the prior pulls, which takes one block's worth.
    scores = scores - scores.mean(axis=0)
    squares = float(np.einsum("bi,ij,bj->", scores, adjusted.inverse(), scores)) / adjusted.scale**2
    return max(squares / adjusted.fixed_by_data() * len(scores) / (len(scores) - 1), 1.0)


def _block_scores(linear: Linearisation) -> Array:
    """(b, S d) gradients of the sought cameras' parameters, the motion eliminated, summed over blocks of time.

    Where the motion follows the cameras by G, an interval's score is J_c^T r - G^T J_m^T r.
    """
    problem = linear.problem
    half, d, sought = 6 * len(problem.wand.basis), len(problem.free), list(problem.cameras())
    links, local = len(linear.chain), 2 * half
    hessian, gradient = linear.chain[:, :local, :local].copy(), linear.chain[:, :local, -1].copy()
    crossed = np.zeros((links, local, len(sought) * d))
    scores = np.zeros((links, len(sought) * d))
    for link, camera, rows in _views(linear):
        J, r = rows[:, :local], rows[:, -1]
        hessian[link] += J.T @ J
        gradient[link] += J.T @ r
        if camera in sought:
            columns = slice(d * sought.index(camera), d * sought.index(camera) + d)
            crossed[link, :, columns] += J.T @ rows[:, local:-1]
            scores[link, columns] += rows[:, local:-1].T @ r
    follow = _solve_chain(hessian, crossed)
    scores -= np.einsum("lic,li->lc", follow, gradient)
    knot_s = problem.knot_s[:-1]
    block = np.unique(((knot_s - knot_s[0]) / BLOCK_S).astype(np.intp), return_inverse=True)[1]
    summed = np.zeros((int(block.max()) + 1, scores.shape[1]))
    np.add.at(summed, block, scores)
    return summed


def _views(linear: Linearisation):
    """Interval, camera, and whitened rows of all that the camera saw in it."""
    links, cameras = np.divmod(linear.views, len(linear.problem.lenses))
    for link, camera, i, j in zip(links, cameras, linear.ends, linear.ends[1:], strict=False):
        yield int(link), int(camera), linear.rows[i:j]


def _solve_chain(hessian: Array, crossed: Array) -> Array:
    """(L, m, n) the solution of a chain of overlapping Hessians (L, m, m) for right-hand sides (L, m, n); each block
    shares the second half of its rows with the first half of the next."""
    from scipy.linalg import solveh_banded

    links, local, columns = crossed.shape
    half = local // 2
    banded, right = np.zeros((local, (links + 1) * half)), np.zeros((links + 1, half, columns))
    for a in range(local):
        for b in range(a + 1):
            np.add.at(banded[a - b], np.arange(links) * half + b, hessian[:, a, b])
    right[:-1] += crossed[:, :half]
    right[1:] += crossed[:, half:]
    found = solveh_banded(banded, right.reshape(-1, columns), lower=True).reshape(right.shape)
    return np.concatenate([found[:-1], found[1:]], axis=1)
