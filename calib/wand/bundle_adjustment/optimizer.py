# SPDX-License-Identifier: BSD-3-Clause
"""Optimizes the cameras, their clocks and lenses, and the wand's motion and shape, with Levenberg-Marquardt.

A rough start is optimized robustly by iteratively reweighted least squares: Cauchy's weights at a scale that the
residuals give. The final estimate is plain least squares without the observations that the statistics reject, with the
motion profiled out (`ProfiledMotion`): otherwise cameras would be moved to make the wand's path smoother.

The motion is a chain, so its Hessian is block tridiagonal, and one factorization eliminates it for all global
parameters at once (Schur complement): those of the cameras, then the wand's shape. What remains is a graph of these,
their information and their priors, which GTSAM solves.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from scipy.linalg import get_blas_funcs, get_lapack_funcs

from calib.rig.camera import LENS, PER_CAMERA, READOUT
from calib.rig.estimation import CAUCHY_SCALE, GROSS, coordinate_sigma
from calib.wand.bundle_adjustment.covariance import FOCAL, inflation_factor
from calib.wand.bundle_adjustment.problem import (
    Adjusted,
    Problem,
    State,
    WandObservations,
    invert_information,
)
from calib.wand.bundle_adjustment.residuals import (
    Choice,
    ErrorNorms,
    LinearSystem,
    Weights,
    accept_images,
    error_norms,
    find_weights,
    linearize,
    locate_points,
    locate_points_robustly,
    point_error_norms,
    reprojection_errors,
)
from camera_node.foundation.arrays import Array, Index

# Cholesky factors and triangular solutions, without the checks of NumPy and SciPy, which take longer than these.
[potrf], [trsm] = get_lapack_funcs(["potrf"]), get_blas_funcs(["trsm"])
INTERRUPTED = 4.0  # sigmas, over all coordinates: something hit the wand, or frames are missing
MAX_ITERATIONS, MAX_ROUNDS = 60, 5
# Gauss-Newton steps: recordings of tests/calib need 13 at most, any number where cameras contradict each other.
# Steps that end as short as a tenth of the variance of all parameters are right without convergence.
MAX_PROFILED, MAX_ADDED = 20, 0.1
START_DAMPING, MIN_DAMPING, MAX_DAMPING = 1e-5, 1e-9, 1e6  # the first step is damped by a tenth of the start
# The last step decreases the cost by less than this share, and this absolute amount.
ROBUST_TOLERANCE, TOLERANCE, ABSOLUTE_TOLERANCE = 5e-3, 1e-4, 1e-4
# A profiled step that increases the cost by more than MAX_GROWTH is halved.
MAX_GROWTH, MAX_HALVINGS = 10.0, 5
# Information that fixes the gauge at the first camera and its clock: about the information of the observations. Readout
# times and lenses are no part of the gauge.
ANCHOR = np.array([1e8] * 6 + [1e10, 1e13] + [0.0] * (PER_CAMERA - READOUT[0]))
# Damping of a knot's position and velocity, of the information in the best observed direction of each: a knot that only
# one camera observed is not determined along its viewing ray.
MIN_RELATIVE_INFORMATION = 2.0**-22


def optimize_robustly(problem: Problem, observations: WandObservations, start: State) -> State:
    """Optimize from a rough start with Cauchy's kernel.

    The wand's shape stays as it is while unknown lenses are fixed: their errors would go into it.
    """
    if LENS[0] not in problem.free and (problem.lens_sigma[:, 0] > FOCAL).any():
        problem = replace(problem, estimates_shape=False)
    objective = _Objective(problem, observations, find_weights(problem, observations, start))
    return _levenberg_marquardt(objective, start, damping=1e-3, robust=True)[0]


def adjust(
    problem: Problem,
    observations: WandObservations,
    start: State,
    rounds: int = MAX_ROUNDS,
) -> Adjusted:
    """Optimize from a start that is nearly right, without outliers, and prepare the covariance.

    Each round rejects observations, and interrupts the motion prior, by the statistics of the residuals, and optimizes;
    rounds end where these do not change.
    """
    state, converged, choice, weights = _optimize_exactly(problem, observations, start, rounds)
    inliers = observations.select(choice.observations)
    cameras = profile_motion(linearize(problem, inliers, state, weights))
    adjusted = Adjusted(
        problem=problem,
        state=state,
        used=choice.observations,
        residuals=reprojection_errors(problem, observations, state),
        scale=_noise_scale(problem, inliers, state, weights),
        information=cameras.information,
        shape_covariance=cameras.shape_covariance(problem, state),
        scores=cameras.scores,
        background_used=choice.background,
        converged=converged,
    )
    return replace(adjusted, inflation=inflation_factor(adjusted))


def with_information(adjusted: Adjusted, problem: Problem, observations: WandObservations) -> Adjusted:
    """The adjustment with the information on the free parameters of another problem, at the same state."""
    state, used = adjusted.state, adjusted.used
    weights = find_weights(problem, observations, state)
    interrupted = error_norms(problem, observations, state, weights).interval > INTERRUPTED
    inliers = observations.select(used)
    chosen = weights.select(Choice(used, interrupted, adjusted.background_used))
    cameras = profile_motion(linearize(problem, inliers, state, chosen))
    return replace(adjusted, problem=problem, information=cameras.information, scores=cameras.scores)


def optimize(problem: Problem, observations: WandObservations, start: State) -> State:
    """Optimize from the optimum for more observations of the same motion, without those that it rejects."""
    return _optimize_exactly(problem, observations, start, rounds=1)[0]


def _optimize_exactly(
    problem: Problem, observations: WandObservations, state: State, rounds: int
) -> tuple[State, bool, Choice, Weights]:
    """The optimal state, whether it is one, what it is adjusted to, and the weights of that, in rounds.

    Where the motion can't be profiled out at once, it is from the common optimum of cameras and motion, which is
    reached from farther away. Where it can't from there, the motion reconciles cameras that contradict each other: no
    further round would change that, and the common optimum is returned.
    """
    none = np.zeros(len(observations), bool)
    choice = Choice(none, np.zeros(len(problem.knot_s) - 1, bool), np.zeros(len(problem.background.uv), bool))
    for _ in range(rounds):
        weights = find_weights(problem, observations, state)
        better = _choose(problem, observations, state, weights, choice)
        if better.equals(choice):
            break
        choice = better
        objective = _Objective(problem, observations.select(choice.observations), weights.select(choice))
        state = locate_points(problem, state, choice.background)
        found = _profile(objective, state)
        if found is None:
            state, _ = _levenberg_marquardt(objective, state)
            found = _profile(objective, state)
            if found is None:
                return state, False, choice, weights.select(choice)
        state = found
    else:
        weights = find_weights(problem, observations, state)
    return state, True, choice, weights.select(choice)


def _choose(
    problem: Problem, observations: WandObservations, state: State, weights: Weights, before: Choice
) -> Choice:
    """Reject observations and images of background points, and interrupt the motion prior, by the statistics of the
    residuals; those that were used `before` give the spread of the observations."""
    norms = error_norms(problem, observations, state, weights)
    known = norms.observation[before.observations] if before.observations.any() else norms.observation
    beside = point_error_norms(problem, locate_points_robustly(problem, state))
    most = GROSS * max(coordinate_sigma(beside), 1.0) if len(beside) else GROSS
    return Choice(
        observations=norms.observation < GROSS * max(coordinate_sigma(known), 1.0),
        interrupted=norms.interval > INTERRUPTED,
        background=accept_images(problem, beside, most),
    )


def _noise_scale(problem: Problem, observations: WandObservations, state: State, weights: Weights) -> float:
    """Square root of chi-square over its degrees of freedom: the equations of observations and motion, less the
    parameters. A knot that no motion connects with another has no velocity that counts: only a prior determines it."""
    B, knots = len(problem.wand.basis), len(problem.knot_s)
    connected = weights.motion.any(axis=(1, 2))
    equations = 2 * len(observations) + 6 * B * int(connected.sum()) + len(problem.wand.lengths) * knots
    equations += 2 * int(weights.background.sum())
    moving = np.append(connected, False) | np.append(False, connected)
    with_prior = np.isfinite(problem.prior_sigma()).sum()
    parameters = 3 * B * (knots + int(moving.sum()))
    parameters += 3 * len(np.unique(problem.background.point[weights.background]))
    parameters += len(problem.free) * len(problem.lenses) - 6 - with_prior
    chi2 = 2 * error_norms(problem, observations, state, weights).cost()
    return float(np.sqrt(chi2 / max(equations - parameters, equations / 10)))


@dataclass(frozen=True, slots=True)
class _Objective:
    """The cost of one iteration: Cauchy's kernel at these scales in sigmas, plain least squares where infinite."""

    problem: Problem
    observations: WandObservations
    weights: Weights
    observation_scale: float = np.inf
    interval_scale: float = np.inf

    def norms(self, state: State) -> ErrorNorms:
        return error_norms(self.problem, self.observations, state, self.weights)

    def cost(self, norms: ErrorNorms) -> float:
        return norms.cost(self.observation_scale, self.interval_scale)

    def linearize(self, state: State, norms: ErrorNorms) -> LinearSystem:
        weights = norms.reweight(self.weights, self.observation_scale, self.interval_scale)
        return linearize(self.problem, self.observations, state, weights)


@dataclass(frozen=True, slots=True)
class _Step:
    """A state, its residuals and cost, and the damping that led to it."""

    state: State
    norms: ErrorNorms
    cost: float
    damping: float


def _levenberg_marquardt(
    objective: _Objective, state: State, damping: float = START_DAMPING, robust: bool = False
) -> tuple[State, float]:
    """The optimum and the last damping, from the `damping` of the step before; where `robust`, Cauchy's scale follows
    the residuals."""
    norms = objective.norms(state)
    for _ in range(MAX_ITERATIONS):
        if robust:
            scale = CAUCHY_SCALE * max(coordinate_sigma(norms.observation), 1.0)
            objective = replace(objective, observation_scale=scale, interval_scale=CAUCHY_SCALE)
        before = _Step(state, norms, objective.cost(norms), max(damping / 10, MIN_DAMPING))
        step = _descend(objective, before)
        if step is None:
            break
        state, norms, damping = step.state, step.norms, step.damping
        tolerance = ROBUST_TOLERANCE if robust else TOLERANCE
        if before.cost - step.cost < tolerance * before.cost + ABSOLUTE_TOLERANCE:
            break
    return state, damping


def _profile(objective: _Objective, state: State) -> State | None:
    """The state at which the cameras fit the observations best, with the motion that is optimal for these cameras, by
    Gauss-Newton; None where it does not converge.

    Derivatives along the optimal motion hold only there. From a motion that lags behind its cameras, steps overshoot
    and alternate, so the motion is optimized before each. It follows the cameras as damped as it was optimized: a knot
    that the observations hardly determine would move by metres, and all steps would be cut for it. Steps end where
    those that remain, a geometric series of r standard deviations together, add less to the squared error than anyone
    knows of it: n residuals give a variance to (2 / n)^1/2 of itself. Where observations are few or stamps uncertain,
    steps may alternate at a length that hardly adds to it.
    """
    path = replace(objective, problem=replace(objective.problem, estimated=()))
    most, before, damping = len(objective.observations) ** -0.25, 1.0, START_DAMPING  # two residuals each
    allowed, is_near = MAX_ADDED * len(objective.problem.estimated_rows()), False
    for _ in range(MAX_PROFILED):
        try:
            state, damping = _levenberg_marquardt(path, state, damping)
            norms = objective.norms(state)
            profiled = profile_motion(objective.linearize(state, norms))
            steps, length = profiled.step(objective.problem, state, damping)
        except np.linalg.LinAlgError:
            return None
        stepped = _step_profiled(objective, state, norms, steps)
        if stepped is None or length**2 < most * (before - length):
            return stepped
        state, before, is_near = stepped, min(length, 1.0), length**2 < allowed
    return state if is_near else None


def _step_profiled(
    objective: _Objective, state: State, norms: ErrorNorms, steps: tuple[Array, Array, Array]
) -> State | None:
    """Take the `steps` of cameras, motion and shape from a state with residuals `norms`, or a part of them; None where
    the cost grows much with all parts."""
    most = MAX_GROWTH * objective.cost(norms) + 1
    for share in 0.5 ** np.arange(MAX_HALVINGS):
        try:
            moved = objective.problem.retract(state, *(share * step for step in steps))
            moved = locate_points(objective.problem, moved, objective.weights.background)
            if objective.cost(objective.norms(moved)) < most:
                return moved
        except ValueError:  # Lens: impossible parameters
            pass
    return None


def _descend(objective: _Objective, before: _Step) -> _Step | None:
    """The first step that does not increase the cost, damping ever more; None where there is none."""
    system, damping = objective.linearize(before.state, before.norms), before.damping
    while damping <= MAX_DAMPING:
        try:
            state = objective.problem.retract(before.state, *solve_step(system, damping))
            state = locate_points(objective.problem, state, objective.weights.background)
            norms = objective.norms(state)
            if (cost := objective.cost(norms)) <= before.cost:
                return _Step(state, norms, cost, damping)
        except (RuntimeError, ValueError):  # a nearly singular system; Lens: impossible parameters
            pass
        damping *= 10
    return None


@dataclass(frozen=True, slots=True)
class ProfiledMotion:
    """A linear system with the motion, h = 6 B scalars at a knot, and the wand's shape replaced by those that are
    optimal for the cameras.

    The motion prior chooses that motion, and constrains the cameras no further: it does not know the size of the
    motion, so cameras that make a path smoother are no better (generalized profiling: Ramsay, Hooker, Campbell and Cao,
    Journal of the Royal Statistical Society B 69, 2007).

    Attributes:
        information: (S d, S d) on the free parameters of the S estimated cameras, with their priors.
        scores: (L + J, S d) gradients by interval between knots, then by background point, without priors.
        gradient: (S d,) their sum, with priors.
        of_shape, shape_gradient: (n, n) information on the shape, the cameras fixed, and (n,) its gradient.
        response: (n, S d) what the shape changes less for a change of the cameras.
        sums: the equations before the motion was replaced.
    """

    information: Array
    scores: Array
    gradient: Array
    of_shape: Array
    shape_gradient: Array
    response: Array
    sums: "_Sums"

    def step(
        self, problem: Problem, state: State, damping: float
    ) -> tuple[tuple[Array, Array, Array], float]:
        """The Gauss-Newton step, (C, 18) of the cameras, (K, h) of the motion, which is damped, and (n,) of the shape,
        and how far it is: its Mahalanobis length in cameras and shape."""
        of_cameras = invert_information(problem, state, self.information) @ self.gradient
        alone = np.linalg.solve(self.of_shape, self.shape_gradient)
        shape_step = alone - self.response @ of_cameras
        right = self.sums.gradient - self.sums.crossed @ np.append(of_cameras, shape_step)
        motion_step = self.sums.motion.damp(damping).factorize().solve(right[:, :, None])[:, :, 0]
        squared = abs(of_cameras @ self.gradient) + abs(alone @ self.shape_gradient)
        return (_all_parameters(problem, of_cameras), motion_step, shape_step), float(np.sqrt(squared))

    def shape_covariance(self, problem: Problem, state: State) -> Array:
        """(n, n) covariance of the wand's shape."""
        of_cameras = invert_information(problem, state, self.information)
        return np.asarray(np.linalg.inv(self.of_shape) + self.response @ of_cameras @ self.response.T, float)


def solve_step(system: LinearSystem, damping: float) -> tuple[Array, Array, Array]:
    """Solve for the step of Levenberg-Marquardt: (C, 18) of the cameras, (K, h) of the motion and (n,) of the shape.

    The Hessian's diagonal is multiplied by 1 + `damping` (Marquardt). Where all cameras are estimated, the first camera
    and its clock are fixed (gauge).

    Raises:
        RuntimeError, LinAlgError: the system is nearly singular; more damping helps.
    """
    sums = _Sums.of(system)
    (knots, h), size = sums.gradient.shape, len(sums.of_globals)
    motion = sums.motion.damp(damping).factorize()
    right = np.concatenate([sums.crossed, sums.gradient[:, :, None]], axis=2)
    response, motion_step = np.split(motion.solve(right), [size], axis=2)
    crossed = sums.crossed.reshape(knots * h, size)
    information = sums.of_globals - crossed.T @ response.reshape(knots * h, size)
    information += damping * np.diag(np.diag(sums.of_globals))
    gradient = sums.scores.sum(axis=0) - crossed.T @ motion_step.ravel()
    step = _solve_globals(system, information, gradient) if size else gradient
    of_cameras, of_shape = np.split(step, [size - system.problem.shapes])
    shape_step = np.zeros(len(system.problem.wand.shapes))
    shape_step[: len(of_shape)] = of_shape  # 0 where the shape is fixed
    return _all_parameters(system.problem, of_cameras), motion_step[:, :, 0] - response @ step, shape_step


def _solve_globals(system: LinearSystem, information: Array, gradient: Array) -> Array:
    """(S d + n,) the step of the estimated cameras and of the wand's shape, from their information and gradient, to
    which their priors are added.

    Raises:
        RuntimeError: the system is nearly singular.
    """
    import gtsam

    problem, graph, ordering = system.problem, gtsam.GaussianFactorGraph(), gtsam.Ordering()
    free, count = list(problem.free), len(problem.estimated_cameras())
    rows, (by_priors, prior_gradient) = problem.global_rows(), system.priors
    H, g = information + by_priors[np.ix_(rows, rows)], gradient + prior_gradient[rows]
    # Those of each camera, then those of the shape.
    parts = np.split(np.arange(len(rows)), len(free) * np.arange(1, count + (problem.shapes > 0)))
    zeros = [(np.zeros((len(part), len(part))), np.zeros(len(part))) for part in parts]
    for k, part in enumerate(parts):
        ordering.push_back(k)
        graph.push_back(gtsam.HessianFactor(k, H[np.ix_(part, part)], g[part], 0.0))
    for a, b in combinations(range(len(parts)), 2):  # only the sum of all is positive definite
        crossed = H[np.ix_(parts[a], parts[b])]
        graph.push_back(gtsam.HessianFactor(a, b, zeros[a][0], crossed, zeros[a][1], *zeros[b], 0.0))
    if problem.estimated is None:
        graph.push_back(gtsam.HessianFactor(0, np.diag(ANCHOR[free]), zeros[0][1], 0.0))
    step = graph.optimize(ordering)
    return np.concatenate([step.at(k) for k in range(len(parts))])


def _all_parameters(problem: Problem, of_cameras: Array) -> Array:
    """(C, 18) steps of all parameters of all cameras, from those (S d,) of the estimated ones; 0 for the others."""
    estimated, step = list(problem.estimated_cameras()), np.zeros((len(problem.lenses), PER_CAMERA))
    step[np.ix_(estimated, problem.free)] = of_cameras.reshape(len(estimated), len(problem.free))
    return step


def profile_motion(system: LinearSystem) -> ProfiledMotion:
    """Eliminate the motion, then the wand's shape.

    With H the Hessian, g the gradient and P the Hessian of the motion prior, the response of the motion is
    G = H_mm^-1 H_mc, and the derivatives of the observations by the cameras, along the optimal motion, are
    D = J_c - J_m G. A smooth path is shorter than the true one, and cameras that make it longer fit better. So the
    residuals r are fitted once more, r - J_m H_mm^-1 J_m^T r, before they are compared with D (twicing: Newey, Hsieh
    and Robins, Econometrica 72, 2004). With J_m^T D = P G the score is D^T r - (P G)^T H_mm^-1 J_m^T r, and the
    information H_cc - G^T (H_mc + P G) - (P G)^T H_mm^-1 P G, which is H_cc - M^T H_mm^-1 M + G^T P G with
    M = H_mc + P G. Of the shape, the Schur complement is taken of these.

    Raises:
        LinAlgError: the motion's Hessian is not positive definite.
    """
    sums = _Sums.of(system)
    h, size = sums.gradient.shape[1], len(sums.of_globals)
    prior = system.motion_prior[:, : 2 * h, : 2 * h]
    motion = sums.motion.factorize()
    right = np.concatenate([sums.crossed, _add_ends(sums.observed[:, :, None])], axis=2)
    G, again = np.split(motion.solve(right), [size], axis=2)
    by_prior = BlockTridiagonal.of_chain(prior).multiply(G)
    whitened = motion.whiten(sums.crossed + by_prior).reshape(-1, size)
    # By interval: the prior of each moves the paths of both its knots.
    pulled = sums.observed + (prior @ np.concatenate([again[:-1], again[1:]], axis=1))[:, :, 0]
    scores = sums.scores.copy()
    scores[: len(pulled)] -= (pulled[:, None, :h] @ G[:-1] + pulled[:, None, h:] @ G[1:])[:, 0]
    information = sums.of_globals - whitened.T @ whitened + G.reshape(-1, size).T @ by_prior.reshape(-1, size)
    rows, (by_priors, prior_gradient) = system.problem.global_rows(), system.priors
    H, gradient = information + by_priors[np.ix_(rows, rows)], scores.sum(axis=0) + prior_gradient[rows]
    cameras = size - system.problem.shapes
    of_shape, crossed = H[cameras:, cameras:], H[cameras:, :cameras]
    response = np.asarray(np.linalg.solve(of_shape, crossed), float)
    return ProfiledMotion(
        information=H[:cameras, :cameras] - crossed.T @ response,
        scores=scores[:, :cameras] - scores[:, cameras:] @ response,
        gradient=gradient[:cameras] - gradient[cameras:] @ response,
        of_shape=of_shape,
        shape_gradient=gradient[cameras:],
        response=response,
        sums=sums,
    )


@dataclass(frozen=True, slots=True)
class BlockTridiagonal:
    """A symmetric matrix of K x K blocks: `diagonal` (K, h, h), and `below` (K - 1, h, h) in row k + 1, column k.

    Its factorization by blocks (Golub and Van Loan, Matrix Computations, section 4.5) solves all right-hand sides at
    once by matrix products. LAPACK's banded solver takes each by itself, and is several times slower.
    """

    diagonal: Array
    below: Array

    @classmethod
    def of_chain(cls, parts: Array) -> "BlockTridiagonal":
        """The sum of overlapping symmetric matrices (K - 1, 2 h, 2 h), each of a block and the next."""
        h = parts.shape[1] // 2
        diagonal = np.zeros((len(parts) + 1, h, h))
        diagonal[:-1] += parts[:, :h, :h]
        diagonal[1:] += parts[:, h:, h:]
        return cls(diagonal, parts[:, h:, :h])

    def damp(self, damping: float) -> "BlockTridiagonal":
        """The matrix with its diagonal multiplied by 1 + `damping`, and the least information added."""
        knots, h = self.diagonal.shape[:2]
        diagonal = np.einsum("kii->ki", self.diagonal)
        best = diagonal.reshape(knots, 2, -1).max(axis=2)
        added = damping * diagonal + MIN_RELATIVE_INFORMATION * np.repeat(best, h // 2, axis=1)
        return BlockTridiagonal(self.diagonal + added[:, :, None] * np.eye(h), self.below)

    def multiply(self, columns: Array) -> Array:
        """The product with columns (K, h, n), of the same shape."""
        product = self.diagonal @ columns
        product[1:] += self.below @ columns[:-1]
        product[:-1] += self.below.mT @ columns[1:]
        return product

    def factorize(self) -> "BlockFactors":
        """Factorize the matrix.

        Raises:
            LinAlgError: it is not positive definite.
        """
        blocks = self.diagonal.copy()
        for k, link in enumerate(self.below):
            # The Cholesky factor of what remains of this block after the elimination of those before.
            by_link = trsm(1.0, potrf(blocks[k], lower=1)[0], link.T, lower=1)
            blocks[k + 1] -= by_link.T @ by_link
        root = np.asarray(np.linalg.inv(np.linalg.cholesky(blocks)), float)
        return BlockFactors(root, self.below @ (root[:-1].mT @ root[:-1]))


@dataclass(frozen=True, slots=True)
class BlockFactors:
    """L D L^T of a matrix H.

    Attributes:
        root: (K, h, h) the inverse Cholesky factors of the blocks of D.
        below: (K - 1, h, h) the blocks of L below its diagonal.
    """

    root: Array
    below: Array

    def whiten(self, right: Array) -> Array:
        """R x for columns x (K, h, n), of the same shape, with R^T R = H^-1."""
        x = right.copy()
        for k, below in enumerate(self.below):
            x[k + 1] -= below @ x[k]
        return self.root @ x

    def solve(self, right: Array) -> Array:
        """The solution for right-hand sides (K, h, n), of the same shape."""
        x = self.root.mT @ self.whiten(right)
        for k in reversed(range(len(self.below))):
            x[k] -= self.below[k].T @ x[k + 1]
        return x


@dataclass(frozen=True, slots=True)
class _Sums:
    """The normal equations of all residuals, without the priors of the global parameters: of the S estimated cameras,
    and of the wand's shape.

    Attributes:
        motion: Hessian of the motion.
        gradient: (K, h) of the motion, by knot.
        observed: (L, 2 h) of the motion, by interval, without the motion prior.
        crossed: (K, h, S d + n) products of the derivatives by the motion and by the global parameters.
        scores: (L + J, S d + n) gradients of the global parameters, by interval, then by background point.
        of_globals: (S d + n, S d + n) Hessian of the global parameters, with background points.
    """

    motion: BlockTridiagonal
    gradient: Array
    observed: Array
    crossed: Array
    scores: Array
    of_globals: Array

    @classmethod
    def of(cls, system: LinearSystem) -> "_Sums":
        h = 6 * len(system.problem.wand.basis)
        chain = _sum_chain(system)
        by_cameras, shape_by_cameras, camera_scores = _sum_cameras(system)
        of_cameras, of_shape = _sum_camera_hessians(system), chain[:, 2 * h : -1, 2 * h : -1].sum(axis=0)
        shape_scores = np.zeros((len(camera_scores), len(of_shape)))
        shape_scores[: len(chain)] = chain[:, 2 * h : -1, -1]
        return cls(
            motion=BlockTridiagonal.of_chain(chain[:, : 2 * h, : 2 * h]),
            gradient=_add_ends(chain[:, : 2 * h, -1:])[:, :, 0],
            observed=chain[:, : 2 * h, -1] - system.motion_prior[:, : 2 * h, -1],
            crossed=np.concatenate([by_cameras, _add_ends(chain[:, : 2 * h, 2 * h : -1])], axis=2),
            scores=np.concatenate([camera_scores, shape_scores], axis=1),
            of_globals=np.block([[of_cameras, shape_by_cameras.T], [shape_by_cameras, of_shape]]),
        )


def _add_ends(parts: Array) -> Array:
    """(K, h, n) sums by knot of parts (K - 1, 2 h, n), each of a knot and the next."""
    h = parts.shape[1] // 2
    sums = np.zeros((len(parts) + 1, h, parts.shape[2]))
    sums[:-1] += parts[:, :h]
    sums[1:] += parts[:, h:]
    return sums


def _sum_chain(system: LinearSystem) -> Array:
    """`LinearSystem.chain` with the observations."""
    chain, d = system.chain.copy(), len(system.problem.free)
    interval = system.views // len(system.problem.lenses)
    first = np.flatnonzero(np.diff(interval, prepend=-1))
    for part, rows in _equal_blocks(system.rows, np.append(system.bounds[first], system.bounds[-1])):
        chain[interval[first[part]]] += rows[:, :, d:].mT @ rows[:, :, d:]
    return chain


def _sum_cameras(system: LinearSystem) -> tuple[Array, Array, Array]:
    """Products (K, h, S d) of the derivatives by the motion and (n, S d) by the shape with those by the estimated
    cameras, and the scores (L + J, S d) of these."""
    estimated, n, d = (
        list(system.problem.estimated_cameras()),
        system.problem.shapes,
        len(system.problem.free),
    )
    L, h, size = len(system.chain), 6 * len(system.problem.wand.basis), len(estimated) * d
    crossed, by_shape = np.zeros((L + 1, h, len(estimated), d)), np.zeros((len(estimated), n, d))
    scores = np.zeros((L, len(estimated), d))
    slot = np.full(len(system.problem.lenses), -1)
    slot[estimated] = np.arange(len(estimated))
    interval, camera = np.divmod(system.views, len(slot))
    for part, rows in _equal_blocks(system.rows, system.bounds):
        mine = slot[camera[part]] >= 0
        at, of, J = interval[part[mine]], slot[camera[part[mine]]], rows[mine]
        by_both = J[:, :, d:].mT @ J[:, :, :d]
        crossed[at, :, of] += by_both[:, :h]
        crossed[at + 1, :, of] += by_both[:, h : 2 * h]
        np.add.at(by_shape, of, by_both[:, 2 * h : -1])
        scores[at, of] = by_both[:, -1]
    beside = system.point_scores[:, estimated]
    return (
        crossed.reshape(L + 1, h, size),
        np.swapaxes(by_shape, 0, 1).reshape(n, size),
        np.concatenate([scores, beside]).reshape(L + len(beside), size),
    )


def _sum_camera_hessians(system: LinearSystem) -> Array:
    """(S d, S d) Hessian of the cameras, with background points, without priors."""
    estimated, d = list(system.problem.estimated_cameras()), len(system.problem.free)
    of_row = np.repeat(system.views % len(system.problem.lenses), np.diff(system.bounds))
    own = system.by_points[np.ix_(estimated, range(d), estimated, range(d))]
    for k, camera in enumerate(estimated):
        J = system.rows[of_row == camera, :d]
        own[k, :, k] += J.T @ J
    return np.asarray(own.reshape(len(estimated) * d, len(estimated) * d), float)


def _equal_blocks(rows: Array, bounds: Index) -> Iterator[tuple[Index, Array]]:
    """Indices (v,) of blocks of rows with the same size, and the blocks (v, n, m), for each size."""
    size = np.diff(bounds)
    for n in np.unique(size).tolist():
        part = np.flatnonzero(size == n)
        yield part, rows[bounds[part, None] + np.arange(n)]
