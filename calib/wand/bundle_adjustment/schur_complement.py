# SPDX-License-Identifier: BSD-3-Clause
"""Eliminates the wand's motion from a linear system (Schur complement), which leaves the cameras' step and information.

The motion is a chain, so its Hessian is banded, and one Cholesky factorization eliminates it for all cameras at once.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from calib.rig.camera import PER_CAMERA
from calib.wand.bundle_adjustment.linear_system import LinearSystem
from calib.wand.bundle_adjustment.problem import Problem, State, gauge_directions
from camera_node.arrays import Array, Index


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
        response: (K h, S d) minus the derivative of the optimal motion by the cameras.
        motion_step: (K h,) from the motion to the optimal one, with the cameras as they are.
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
        return camera_step, motion_step.reshape(len(problem.knot_s), -1), float(of_cameras @ self.gradient)


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
    Their information is H_cc - H_cm G - G^T P G, and their score J_c^T r - G^T J_m^T r.
    """
    local = 12 * len(system.problem.wand.basis)
    sums = _Sums.of(system)
    joined = _join(np.concatenate([sums.crossed, sums.gradient[:, :, None]], axis=2))
    solved = _solve_chain(sums.hessian, joined)
    G = np.ascontiguousarray(solved[:, :-1])
    pairs = _pair(G, local)
    by_prior = _join(system.motion_prior[:, :local, :local] @ pairs)
    information = sums.of_cameras - joined[:, :-1].T @ G - G.T @ by_prior
    observed = sums.gradient - system.motion_prior[:, :local, -1]
    of_motion = sums.scores - (observed[:, None] @ pairs)[:, 0]
    estimated = list(system.problem.estimated_cameras())
    of_points = system.background.scores[:, estimated].reshape(-1, of_motion.shape[1])
    scores = np.concatenate([of_motion, of_points])
    total = scores.sum(axis=0) + _prior_gradient(system)
    return ProfiledMotion(information, scores, total, G, solved[:, -1])


@dataclass(frozen=True, slots=True)
class _Sums:
    """The normal equations of all residuals.

    Attributes:
        hessian, gradient: (L, 2 h, 2 h) and (L, 2 h) of the motion, by interval.
        crossed: (L, 2 h, S d) products of the derivatives by the motion and by the cameras.
        scores: (L, S d) gradients of the cameras, without priors.
        of_cameras: (S d, S d) Hessian of the cameras, with background points and priors.
    """

    hessian: Array
    gradient: Array
    crossed: Array
    scores: Array
    of_cameras: Array

    @classmethod
    def of(cls, system: LinearSystem) -> "_Sums":
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
        size = len(estimated) * d
        return cls(
            hessian,
            gradient,
            crossed.reshape(intervals, local, size),
            scores.reshape(intervals, size),
            own.reshape(size, size),
        )


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


def _normal_equations(system: LinearSystem) -> Iterator[tuple[Index, Index, Array]]:
    """Intervals, ascending, cameras, and augmented Hessians (v, m, m), of all views with the same number of rows."""
    interval, camera = np.divmod(system.views, len(system.problem.lenses))
    size = np.diff(system.bounds)
    for n in np.unique(size).tolist():
        views = np.flatnonzero(size == n)
        rows = system.rows[system.bounds[views, None] + np.arange(n)]
        yield interval[views], camera[views], np.swapaxes(rows, 1, 2) @ rows


def _pair(columns: Array, local: int) -> Array:
    """(L, 2 h, n) the rows (K h, n) of a chain by interval: those of its two knots."""
    by_knot = columns.reshape(-1, local // 2, columns.shape[1])
    return np.concatenate([by_knot[:-1], by_knot[1:]], axis=1)


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
