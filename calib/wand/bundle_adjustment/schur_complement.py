# SPDX-License-Identifier: BSD-3-Clause
"""Solves a linear system: NumPy eliminates the wand's motion (Schur complement), GTSAM the cameras.

The motion is a chain, so its Hessian is block tridiagonal, and one factorization eliminates it for all cameras at once.
What remains is a graph of the cameras: their information, and their priors.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import combinations
from typing import Any, cast

import numpy as np

from calib.rig.camera import PER_CAMERA, READOUT
from calib.wand.block_tridiagonal import BlockTridiagonal
from calib.wand.bundle_adjustment.linear_system import LinearSystem
from calib.wand.bundle_adjustment.problem import Problem, State, gauge_directions
from calib.wand.bundle_adjustment.residuals import CameraPrior
from camera_node.foundation.arrays import Array, Index

# Information that fixes the gauge at the first camera and its clock: about the information of the observations. Readout
# times and lenses are no part of the gauge.
ANCHOR = np.array([1e8] * 6 + [1e10, 1e13] + [0.0] * (PER_CAMERA - READOUT[0]))
# Damping of a knot's position and velocity, of the information in the best observed direction of each: a knot that only
# one camera observed is not determined along its viewing ray.
MIN_RELATIVE_INFORMATION = 2.0**-22


@dataclass(frozen=True, slots=True)
class ProfiledMotion:
    """A linear system with the motion replaced by the one that is optimal for the cameras, h = 6 B scalars at a knot.

    The motion prior chooses that motion, and constrains the cameras no further: it does not know the size of the
    motion, so cameras that make a path smoother are no better (generalized profiling: Ramsay, Hooker, Campbell and Cao,
    Journal of the Royal Statistical Society B 69, 2007).

    Attributes:
        information: (S d, S d) on the free parameters of the S estimated cameras, with their priors.
        scores: (L + J, S d) gradients by interval between knots, then by background point, without the cameras' priors.
        gradient: (S d,) their sum, with the cameras' priors.
        response: (K, h, S d) minus the derivative of the optimal motion by the cameras.
        motion_step: (K, h) from the motion to the optimal one, with the cameras as they are.
    """

    information: Array
    scores: Array
    gradient: Array
    response: Array
    motion_step: Array

    def step(self, problem: Problem, state: State) -> tuple[Array, Array, float]:
        """The Gauss-Newton step, (C, 18) of the cameras and (K, h) of the motion, and how far it is: the square of its
        Mahalanobis length in the cameras."""
        of_cameras = invert_information(problem, state, self.information) @ self.gradient
        motion_step = self.motion_step - self.response @ of_cameras
        return _all_parameters(problem, of_cameras), motion_step, float(of_cameras @ self.gradient)


def solve_step(system: LinearSystem, damping: float) -> tuple[Array, Array]:
    """Solve for the step of Levenberg-Marquardt: (C, 18) of the cameras and (K, h) of the motion.

    The Hessian's diagonal is multiplied by 1 + `damping` (Marquardt). Where all cameras are estimated, the first camera
    and its clock are fixed (gauge).

    Raises:
        RuntimeError, LinAlgError: the system is nearly singular; more damping helps.
    """
    sums = _Sums.of(system)
    (knots, h), size = sums.gradient.shape, len(sums.of_cameras)
    diagonal = np.einsum("kii->ki", sums.motion.diagonal)
    best = diagonal.reshape(knots, 2, -1).max(axis=2)
    least = MIN_RELATIVE_INFORMATION * np.repeat(best, h // 2, axis=1)
    motion = sums.motion.add_diagonal(damping * diagonal + least).factorize()
    right = np.concatenate([sums.crossed, sums.gradient[:, :, None]], axis=2)
    response, motion_step = np.split(motion.solve(right), [size], axis=2)
    crossed = sums.crossed.reshape(-1, size)
    information = sums.of_cameras - crossed.T @ response.reshape(-1, size)
    information += damping * np.diag(np.diag(sums.of_cameras))
    gradient = sums.scores.sum(axis=0) - crossed.T @ motion_step.ravel()
    of_cameras = _solve_cameras(system, information, gradient)
    return _all_parameters(system.problem, of_cameras), motion_step[:, :, 0] - response @ of_cameras


def _solve_cameras(system: LinearSystem, information: Array, gradient: Array) -> Array:
    """(S d,) the step of the estimated cameras, from their information and gradient, to which their priors are added.

    Raises:
        RuntimeError: the system is nearly singular.
    """
    import gtsam

    free, estimated = list(system.problem.free), list(system.problem.estimated_cameras())
    d, graph, ordering = len(free), gtsam.GaussianFactorGraph(), gtsam.Ordering()
    H, g = information.reshape(len(estimated), d, len(estimated), d), gradient.reshape(-1, d)
    zero, none = np.zeros((d, d)), np.zeros(d)
    for k in range(len(estimated)):
        ordering.push_back(k)
        graph.push_back(gtsam.HessianFactor(k, H[k, :, k], g[k], 0.0))
    for a, b in combinations(range(len(estimated)), 2):  # only the sum of all is positive definite
        graph.push_back(gtsam.HessianFactor(a, b, zero, H[a, :, b], none, zero, none, 0.0))
    for cameras, prior in _estimated_priors(system):
        blocks = [part for block in zip(cameras, prior.jacobians, strict=True) for part in block]
        unit = gtsam.noiseModel.Unit.Create(len(prior.error))
        graph.push_back(cast(Any, gtsam.JacobianFactor)(*blocks, prior.error, unit))
    if system.problem.estimated is None:
        graph.push_back(gtsam.HessianFactor(0, np.diag(ANCHOR[free]), none, 0.0))
    step = graph.optimize(ordering)
    return np.concatenate([step.at(k) for k in range(len(estimated))])


def _all_parameters(problem: Problem, of_cameras: Array) -> Array:
    """(C, 18) steps of all parameters of all cameras, from those (S d,) of the estimated ones; 0 for the others."""
    estimated, step = problem.estimated_cameras(), np.zeros((len(problem.lenses), PER_CAMERA))
    step[np.ix_(estimated, problem.free)] = of_cameras.reshape(len(estimated), -1)
    return step


def invert_information(problem: Problem, state: State, information: Array) -> Array:
    """(S d, S d) pseudo-inverse of the information on the estimated cameras, without the gauge."""
    if problem.estimated is not None:
        return np.asarray(np.linalg.inv(information), float)
    gauge = gauge_directions(state, problem.free)
    rest = np.linalg.svd(gauge)[0][:, gauge.shape[1] :]
    return np.asarray(rest @ np.linalg.inv(rest.T @ information @ rest) @ rest.T, float)


def profile_motion(system: LinearSystem) -> ProfiledMotion:
    """Eliminate the motion.

    With H the Hessian, g the gradient and P the Hessian of the motion prior, the response of the motion is
    G = H_mm^-1 H_mc, and the derivatives of the observations by the cameras, along the optimal motion, are J_c - J_m G.
    Their information is H_cc - G^T (H_mc + P G), and their score J_c^T r - G^T J_m^T r.

    Raises:
        LinAlgError: the motion's Hessian is not positive definite.
    """
    sums, prior = _Sums.of(system), system.motion_prior[:, :-1, :-1]
    h, size = sums.gradient.shape[1], len(sums.of_cameras)
    motion = sums.motion.factorize()
    G = motion.solve(sums.crossed)
    along = (sums.crossed + BlockTridiagonal.of_chain(prior).multiply(G)).reshape(-1, size)
    observed = sums.observed
    scores = sums.scores.copy()
    scores[: len(observed)] -= (observed[:, None, :h] @ G[:-1] + observed[:, None, h:] @ G[1:])[:, 0]
    by_priors, gradient = _prior_equations(system)
    return ProfiledMotion(
        information=sums.of_cameras + by_priors - G.reshape(-1, size).T @ along,
        scores=scores,
        gradient=scores.sum(axis=0) + gradient,
        response=G,
        motion_step=motion.solve(sums.gradient[:, :, None])[:, :, 0],
    )


@dataclass(frozen=True, slots=True)
class _Sums:
    """The normal equations of all residuals.

    Attributes:
        motion: Hessian of the motion.
        gradient: (K, h) of the motion, by knot.
        observed: (L, 2 h) of the motion, by interval, without the motion prior.
        crossed: (K, h, S d) products of the derivatives by the motion and by the cameras.
        scores: (L + J, S d) gradients of the cameras, by interval, then by background point, without priors.
        of_cameras: (S d, S d) Hessian of the cameras, with background points, without priors.
    """

    motion: BlockTridiagonal
    gradient: Array
    observed: Array
    crossed: Array
    scores: Array
    of_cameras: Array

    @classmethod
    def of(cls, system: LinearSystem) -> "_Sums":
        local, d = 12 * len(system.problem.wand.basis), len(system.problem.free)
        estimated, knots, h = list(system.problem.estimated_cameras()), len(system.chain) + 1, local // 2
        size = len(estimated) * d
        motion = _sum_motion(system, local)
        gradient = np.zeros((knots, h))
        gradient[:-1] += motion[:, :h, -1]
        gradient[1:] += motion[:, h:, -1]
        crossed, scores = _sum_cameras(system, local)
        beside = system.background.scores[:, estimated].reshape(-1, size)
        return cls(
            motion=BlockTridiagonal.of_chain(motion[:, :, :-1]),
            gradient=gradient,
            observed=motion[:, :, -1] - system.motion_prior[:, :-1, -1],
            crossed=crossed.reshape(knots, h, size),
            scores=np.concatenate([scores.reshape(knots - 1, size), beside]),
            of_cameras=_sum_camera_hessians(system, local).reshape(size, size),
        )


def _sum_motion(system: LinearSystem, local: int) -> Array:
    """(L, 2 h, 2 h + 1) Hessians and gradients of the motion, by interval."""
    motion = system.chain[:, :local].copy()
    interval = system.views // len(system.problem.lenses)
    first = np.flatnonzero(np.diff(interval, prepend=-1))
    for part, rows in _equal_blocks(system.rows, np.append(system.bounds[first], system.bounds[-1])):
        at, J = interval[first[part]], rows[:, :, :local]
        motion[at, :, :local] += J.mT @ J
        motion[at, :, local:] += J.mT @ rows[:, :, -1:]
    return motion


def _sum_cameras(system: LinearSystem, local: int) -> tuple[Array, Array]:
    """(K, h, S, d) products of the derivatives by the motion and by the estimated cameras, and (L, S, d) scores."""
    estimated, h, L = list(system.problem.estimated_cameras()), local // 2, len(system.chain)
    crossed = np.zeros((L + 1, h, len(estimated), len(system.problem.free)))
    scores = np.zeros((L, *crossed.shape[2:]))
    slot = np.full(len(system.problem.lenses), -1)
    slot[estimated] = np.arange(len(estimated))
    interval, camera = np.divmod(system.views, len(slot))
    for part, rows in _equal_blocks(system.rows, system.bounds):
        mine = slot[camera[part]] >= 0
        at, of, J = interval[part[mine]], slot[camera[part[mine]]], rows[mine]
        by_both = J[:, :, :local].mT @ J[:, :, local:-1]
        crossed[at, :, of] += by_both[:, :h]
        crossed[at + 1, :, of] += by_both[:, h:]
        scores[at, of] = (J[:, :, -1:].mT @ J[:, :, local:-1])[:, 0]
    return crossed, scores


def _sum_camera_hessians(system: LinearSystem, local: int) -> Array:
    """(S, d, S, d) Hessian of the cameras, with background points, without priors."""
    estimated, d = list(system.problem.estimated_cameras()), len(system.problem.free)
    of_row = np.repeat(system.views % len(system.problem.lenses), np.diff(system.bounds))
    own = system.background.information[np.ix_(estimated, range(d), estimated, range(d))]
    for k, camera in enumerate(estimated):
        J = system.rows[of_row == camera, local:-1]
        own[k, :, k] += J.T @ J
    return own


def _estimated_priors(system: LinearSystem) -> Iterator[tuple[list[int], CameraPrior]]:
    """The priors of estimated cameras, and the places of their cameras among the estimated ones."""
    place = {camera: k for k, camera in enumerate(system.problem.estimated_cameras())}
    for prior in system.priors:
        if place.keys() >= set(prior.cameras):
            yield [place[camera] for camera in prior.cameras], prior


def _prior_equations(system: LinearSystem) -> tuple[Array, Array]:
    """(S d, S d) information and (S d,) gradient of the priors of the estimated cameras."""
    S, d = len(system.problem.estimated_cameras()), len(system.problem.free)
    H, g = np.zeros((S, d, S, d)), np.zeros((S, d))
    for cameras, prior in _estimated_priors(system):
        for a, J_a in zip(cameras, prior.jacobians, strict=True):
            g[a] += J_a.T @ prior.error
            for b, J_b in zip(cameras, prior.jacobians, strict=True):
                H[a, :, b] += J_a.T @ J_b
    return H.reshape(S * d, S * d), g.ravel()


def _equal_blocks(rows: Array, bounds: Index) -> Iterator[tuple[Index, Array]]:
    """Indices (v,) of blocks of rows with the same size, and the blocks (v, n, m), for each size."""
    size = np.diff(bounds)
    for n in np.unique(size).tolist():
        part = np.flatnonzero(size == n)
        yield part, rows[bounds[part, None] + np.arange(n)]
