# SPDX-License-Identifier: BSD-3-Clause
"""Eliminates the wand's motion from a linear system (Schur complement), which leaves the cameras' step and information.

The motion is a chain, so its Hessian is block tridiagonal, and one factorization eliminates it for all cameras at once.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from calib.rig.camera import PER_CAMERA
from calib.wand.block_tridiagonal import BlockTridiagonal
from calib.wand.bundle_adjustment.linear_system import LinearSystem
from calib.wand.bundle_adjustment.problem import Problem, State, gauge_directions
from camera_node.foundation.arrays import Array, Index


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
        camera_step = np.zeros((len(problem.lenses), PER_CAMERA))
        estimated = list(problem.estimated_cameras())
        camera_step[np.ix_(estimated, problem.free)] = of_cameras.reshape(len(estimated), -1)
        motion_step = self.motion_step - self.response @ of_cameras
        return camera_step, motion_step, float(of_cameras @ self.gradient)


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
    motion = BlockTridiagonal.of_chain(sums.hessian).factorize()
    G = motion.solve(sums.crossed)
    along = (sums.crossed + BlockTridiagonal.of_chain(prior).multiply(G)).reshape(-1, size)
    observed = sums.observed
    scores = sums.scores - (observed[:, None, :h] @ G[:-1] + observed[:, None, h:] @ G[1:])[:, 0]
    estimated = list(system.problem.estimated_cameras())
    scores = np.concatenate([scores, system.background.scores[:, estimated].reshape(-1, size)])
    return ProfiledMotion(
        information=sums.of_cameras - G.reshape(-1, size).T @ along,
        scores=scores,
        gradient=scores.sum(axis=0) + _prior_gradient(system),
        response=G,
        motion_step=motion.solve(sums.gradient[:, :, None])[:, :, 0],
    )


@dataclass(frozen=True, slots=True)
class _Sums:
    """The normal equations of all residuals.

    Attributes:
        hessian: (L, 2 h, 2 h) of the motion, by interval.
        gradient: (K, h) of the motion, by knot.
        observed: (L, 2 h) of the motion, by interval, without the motion prior.
        crossed: (K, h, S d) products of the derivatives by the motion and by the cameras.
        scores: (L, S d) gradients of the cameras, without priors.
        of_cameras: (S d, S d) Hessian of the cameras, with background points and priors.
    """

    hessian: Array
    gradient: Array
    observed: Array
    crossed: Array
    scores: Array
    of_cameras: Array

    @classmethod
    def of(cls, system: LinearSystem) -> "_Sums":
        local, d = 12 * len(system.problem.wand.basis), len(system.problem.free)
        h, (knots, size) = local // 2, (len(system.chain) + 1, len(system.problem.estimated_cameras()) * d)
        motion = _sum_motion(system, local)
        gradient = np.zeros((knots, h))
        gradient[:-1] += motion[:, :h, -1]
        gradient[1:] += motion[:, h:, -1]
        crossed, scores = _sum_cameras(system, local)
        return cls(
            hessian=motion[:, :, :-1],
            gradient=gradient,
            observed=motion[:, :, -1] - system.motion_prior[:, :-1, -1],
            crossed=crossed.reshape(knots, h, size),
            scores=scores.reshape(knots - 1, size),
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
    """(S, d, S, d) Hessian of the cameras, with background points and priors."""
    estimated, d = list(system.problem.estimated_cameras()), len(system.problem.free)
    of_row = np.repeat(system.views % len(system.problem.lenses), np.diff(system.bounds))
    own = prior_information(system)
    own += system.background.information[np.ix_(estimated, range(d), estimated, range(d))]
    for k, camera in enumerate(estimated):
        J = system.rows[of_row == camera, local:-1]
        own[k, :, k] += J.T @ J
    return own


def _prior_gradient(system: LinearSystem) -> Array:
    """(S d,) gradient of the priors of the estimated cameras."""
    estimated, d = list(system.problem.estimated_cameras()), len(system.problem.free)
    g = np.zeros((len(estimated), d))
    for prior in system.priors:
        if set(prior.cameras) <= set(estimated):
            for camera, J in zip(prior.cameras, prior.jacobians, strict=True):
                g[estimated.index(camera)] += J.T @ prior.error
    return g.ravel()


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


def _equal_blocks(rows: Array, bounds: Index) -> Iterator[tuple[Index, Array]]:
    """Indices (v,) of blocks of rows with the same size, and the blocks (v, n, m), for each size."""
    size = np.diff(bounds)
    for n in np.unique(size).tolist():
        part = np.flatnonzero(size == n)
        yield part, rows[bounds[part, None] + np.arange(n)]
