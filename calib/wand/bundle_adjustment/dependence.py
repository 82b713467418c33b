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

from calib.wand.bundle_adjustment.optimizer import Adjusted

BLOCK_S = 1.0  # longer than the wand stays in one place
FEWEST = 4  # blocks: of fewer, nothing is concluded


def widen(adjusted: Adjusted) -> Adjusted:
    """The adjustment with covariances widened by what its residuals' dependence asks for."""
    return replace(adjusted, dependence=dependence(adjusted))


def dependence(adjusted: Adjusted) -> float:
    """By what to multiply covariances, 1 or more. Below 1 it never is: the motion that is fitted takes up errors."""
    knot_s = adjusted.problem.knot_s[:-1]
    first = np.flatnonzero(np.diff((knot_s - knot_s[0]) // BLOCK_S, prepend=-1))
    if len(first) < FEWEST:
        return 1.0
    # At the optimum scores sum to what the prior pulls, which takes one block's worth.
    scores = np.add.reduceat(adjusted.scores, first)
    scores = scores - scores.mean(axis=0)
    squares = float(((scores @ adjusted.inverse()) * scores).sum()) / adjusted.scale**2
    return max(squares / adjusted.fixed_by_data() * len(scores) / (len(scores) - 1), 1.0)
