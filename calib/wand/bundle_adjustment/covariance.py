# SPDX-License-Identifier: BSD-3-Clause
"""The covariance of adjusted cameras: from measurement noise, from priors, and for residuals correlated in time.

A lens model that does not fit exactly causes residuals that are alike while the wand is near the same place, for about
a second; a covariance that takes every frame as independent is then too small. The cluster-robust (sandwich) covariance
corrects that (Liang and Zeger 1986; Cameron and Miller 2015): with the scores s_b, summed over blocks of time, and the
information H, it is H^-1 (sum_b s_b s_b^T) H^-1, and equals H^-1 where residuals are independent. A minute has too few
blocks for every entry, but enough for one factor: the mean of its eigenvalues over those of H^-1.
docs/design/wand_adjustment.md has the equations.
"""

from dataclasses import dataclass, replace

import numpy as np

from calib.wand.bundle_adjustment.optimizer import Adjusted
from calib.wand.bundle_adjustment.problem import Problem
from calib.wand.bundle_adjustment.schur_complement import invert_information
from camera_node.foundation.arrays import Array, Index

BLOCK_S = 1.0  # longer than the wand stays in one place
BLOCKS = 10  # of frame sets in order, where these may be any time apart
MIN_BLOCKS = 4  # fewer do not show a correlation


@dataclass(frozen=True, slots=True)
class CameraCovariance:
    """The covariance of all cameras' free parameters; zero for cameras that were not estimated.

    It refers to the world and the time that the cameras define on average (inner constraints; Triggs et al., Bundle
    Adjustment, section 9.3); where some cameras are fixed, to the world of these, which count as exact.

    Attributes:
        free: indices of the d parameters (`calib.rig.camera`).
        noise: (C, d, C, d) the part from measurement noise, as the residuals show it.
        by_prior: (C, d, S d) P: change of each parameter when the given value of a parameter, last axis, is off by its
            standard deviation (`Problem.covariance_prior_sigma`). P P^T is the part from priors: more recordings of the
            wand do not reduce it.
        joint: (C, d, C, d) the sum of both.
    """

    free: tuple[int, ...]
    noise: Array
    by_prior: Array
    joint: Array

    def of(self, parameters: tuple[int, ...]) -> Array:
        """(C, p, C, p) that of some of the parameters; zero where they were not free."""
        count = len(self.joint)
        full = np.zeros((count, len(parameters)) * 2)
        present = [k for k, p in enumerate(parameters) if p in self.free]
        at = [self.free.index(parameters[k]) for k in present]
        full[np.ix_(range(count), present, range(count), present)] = self.joint[:, at][:, :, :, at]
        return full


def camera_covariance(adjusted: Adjusted) -> CameraCovariance:
    """Compute the covariance of an adjustment's cameras."""
    problem, inverse, root = adjusted.problem, inverse_information(adjusted), _prior_root(adjusted)
    by_root = inverse * root
    noise = adjusted.scale**2 * adjusted.inflation * (inverse - by_root @ by_root.T)
    given = problem.covariance_prior_sigma()[list(problem.estimated_cameras())].ravel()
    by_prior = _all_cameras(adjusted, inverse * (root**2 * np.where(root > 0, given, 0.0)), 1)
    noise = _all_cameras(adjusted, noise, 2)
    return CameraCovariance(
        problem.free, noise, by_prior, noise + np.einsum("cpm,eqm->cpeq", by_prior, by_prior)
    )


def inverse_information(adjusted: Adjusted) -> Array:
    """(S d, S d) pseudo-inverse of the information, without the gauge."""
    return invert_information(adjusted.problem, adjusted.state, adjusted.information)


def _prior_root(adjusted: Adjusted) -> Array:
    """(S d,) square root of the priors' information."""
    return 1 / adjusted.problem.prior_sigma()[list(adjusted.problem.estimated_cameras())].ravel()


def _all_cameras(adjusted: Adjusted, part: Array, axes: int) -> Array:
    """The rows (and columns, with two `axes`) of the estimated cameras among those of all; zero for the others."""
    problem = adjusted.problem
    count, d, estimated = len(problem.lenses), len(problem.free), list(problem.estimated_cameras())
    full = np.zeros((count, d, count, d)[: 2 * axes] + part.shape[axes:])
    split = part.reshape((len(estimated), d, len(estimated), d)[: 2 * axes] + part.shape[axes:])
    full[np.ix_(*[estimated, range(d)] * axes)] = split
    return full


def inflate_covariance(adjusted: Adjusted) -> Adjusted:
    """The adjustment with the inflation of its covariance that the correlation of its residuals requires."""
    return replace(adjusted, inflation=inflation_factor(adjusted))


def inflation_factor(adjusted: Adjusted) -> float:
    """The factor of the covariance for residuals correlated in time, at least 1: the estimated motion absorbs errors,
    so an estimate below 1 means nothing."""
    first = _first_intervals(adjusted.problem)
    if len(first) < MIN_BLOCKS:
        return 1.0
    # Each background point is a block of its own.
    first = np.append(first, np.arange(len(adjusted.problem.knot_s) - 1, len(adjusted.scores)))
    # At the optimum the scores sum to minus the priors' gradient: one degree of freedom of the blocks.
    scores = np.add.reduceat(adjusted.scores, first)
    scores = scores - scores.mean(axis=0)
    inverse = inverse_information(adjusted)
    squares = float(((scores @ inverse) * scores).sum()) / adjusted.scale**2
    # The number of parameters that the observations determine; those that only a prior determines do not count.
    determined = float(np.trace(inverse @ (adjusted.information - np.diag(_prior_root(adjusted) ** 2))))
    return max(squares / determined * len(scores) / (len(scores) - 1), 1.0)


def _first_intervals(problem: Problem) -> Index:
    """The first interval between knots of every block: of one second, or of a tenth of the frame sets of
    synchronous cameras."""
    knot_s = problem.knot_s[:-1]
    by_count, by_time = np.arange(len(knot_s)) * BLOCKS // len(knot_s), (knot_s - knot_s[0]) // BLOCK_S
    return np.flatnonzero(np.diff(by_count if problem.gap_s == 0 else by_time, prepend=-1))
