# SPDX-License-Identifier: BSD-3-Clause
"""Optimizes the cameras, their clocks and lenses, and the wand's motion, with Levenberg-Marquardt.

A rough start is optimized robustly by iteratively reweighted least squares: Cauchy's weights at a scale that the
residuals give. The final estimate is plain least squares without the observations that the statistics reject, with the
motion profiled out (`ProfiledMotion`): otherwise cameras would be moved to make the wand's path smoother.
"""

from dataclasses import dataclass, replace

import numpy as np

from calib.wand.bundle_adjustment.eliminated_points import accept, locate, locate_robustly, point_error_norms
from calib.wand.bundle_adjustment.linear_system import LinearSystem, linearize
from calib.wand.bundle_adjustment.problem import Problem, State, WandObservations
from calib.wand.bundle_adjustment.residuals import (
    Choice,
    ErrorNorms,
    Weights,
    error_norms,
    find_weights,
    reprojection_errors,
)
from calib.wand.bundle_adjustment.schur_complement import profile_motion, solve_step
from camera_node.foundation.arrays import Array, Mask

CAUCHY_SCALE = 2.3849  # sigmas: 95 % efficient on normal residuals
REJECTED = 4.5  # sigmas: one true observation in 25,000 is beyond (chi-square, 2 degrees)
INTERRUPTED = 4.0  # sigmas, over all coordinates: something hit the wand, or frames are missing
MAX_ITERATIONS, MAX_ROUNDS = 60, 5
MIN_DAMPING, MAX_DAMPING = 1e-9, 1e6
# The last step decreases the cost by less than this share, and this absolute amount.
ROBUST_TOLERANCE, TOLERANCE, ABSOLUTE_TOLERANCE = 5e-3, 1e-4, 1e-4
# Profiled steps end after one shorter than a standard deviation, over all parameters: the next would be a tenth of it.
# None increases the cost by more than this factor; a step that does is halved.
MAX_PROFILED_STEPS, PROFILED_TOLERANCE = 15, 1.0
MAX_GROWTH, MAX_HALVINGS = 10.0, 5


@dataclass(frozen=True, slots=True)
class Adjusted:
    """The optimal state, and what its covariance follows from (`covariance`).

    Attributes:
        problem: that was optimized.
        state: cameras, clocks, lenses and motion.
        used: (n,) observations that were not rejected.
        residuals: (n, 2) observed minus predicted pixels, of all observations.
        scale: ratio of the residuals to their assumed standard deviations, the square root of the variance factor.
        information: (S d, S d) of the S estimated cameras' free parameters at the assumed noise, with priors. Its null
            space is the gauge: the choice of the world, and of the time that clocks are relative to.
        scores: (L + J, S d) gradients by interval between knots, then by background point, without priors.
        iterations: of all rounds.
        background_used: images of background points that were not rejected.
        inflation: factor of the covariance for residuals that are correlated in time.
    """

    problem: Problem
    state: State
    used: Mask
    residuals: Array
    scale: float
    information: Array
    scores: Array
    iterations: int
    background_used: Mask
    inflation: float = 1.0


def optimize_robustly(problem: Problem, observations: WandObservations, start: State) -> State:
    """Optimize from a rough start with Cauchy's kernel."""
    objective = _Objective(problem, observations, find_weights(problem, observations, start))
    return _levenberg_marquardt(objective, start, robust=True)[0]


def adjust(
    problem: Problem,
    observations: WandObservations,
    start: State,
    rounds: int = MAX_ROUNDS,
    profiled: bool = False,
) -> Adjusted:
    """Optimize from a start that is nearly right, without outliers, and prepare the covariance.

    Each round rejects observations, and interrupts the motion prior, by the statistics of the residuals, and optimizes;
    rounds end where these do not change. A `profiled` start is the optimum of another adjustment of the same motion.
    """
    optimum = _optimize_exactly(problem, observations, start, rounds, profiled)
    state, inliers, weights = optimum.state, observations.select(optimum.used), optimum.weights
    cameras = profile_motion(linearize(problem, inliers, state, weights))
    return Adjusted(
        problem=problem,
        state=state,
        used=optimum.used,
        residuals=reprojection_errors(problem, observations, state),
        scale=_noise_scale(problem, inliers, state, weights),
        information=cameras.information,
        scores=cameras.scores,
        iterations=optimum.iterations,
        background_used=optimum.weights.background,
    )


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
    return _optimize_exactly(problem, observations, start, rounds=1, profiled=True).state


@dataclass(frozen=True, slots=True)
class _Optimum:
    """The optimal state, the observations (n,) that it is adjusted to, their weights, and the iterations it took."""

    state: State
    used: Mask
    weights: Weights
    iterations: int


def _optimize_exactly(
    problem: Problem, observations: WandObservations, state: State, rounds: int, profiled: bool
) -> _Optimum:
    """Optimize in rounds; where the cameras of the start are not `profiled`, the first begins with the common optimum
    of cameras and motion, which is reached from farther away."""
    iterations, none = 0, np.zeros(len(observations), bool)
    choice = Choice(none, np.zeros(len(problem.knot_s) - 1, bool), np.zeros(len(problem.background.uv), bool))
    for _ in range(rounds):
        weights = find_weights(problem, observations, state)
        better = _choose(problem, observations, state, weights, choice)
        if better.equals(choice):
            break
        choice = better
        objective = _Objective(problem, observations.select(choice.observations), weights.select(choice))
        state = locate(problem, state, choice.background)
        found = _profile(objective, state) if profiled else None
        if found is None:
            state, more = _levenberg_marquardt(objective, state, robust=False)
            iterations, found = iterations + more, _profile(objective, state)
        profiled, state = found is not None, state if found is None else found
    else:
        weights = find_weights(problem, observations, state)
    return _Optimum(state, choice.observations, weights.select(choice), iterations)


def _choose(
    problem: Problem, observations: WandObservations, state: State, weights: Weights, before: Choice
) -> Choice:
    """Reject observations and images of background points, and interrupt the motion prior, by the statistics of the
    residuals; those that were used `before` give the spread of the observations."""
    norms = error_norms(problem, observations, state, weights)
    known = norms.observation[before.observations] if before.observations.any() else norms.observation
    beside = point_error_norms(problem, locate_robustly(problem, state))
    most = REJECTED * max(_spread(beside), 1.0) if len(beside) else REJECTED
    return Choice(
        observations=norms.observation < REJECTED * max(_spread(known), 1.0),
        interrupted=norms.interval > INTERRUPTED,
        background=accept(problem, beside, most),
    )


def _spread(norms: Array) -> float:
    """Robust standard deviation of one coordinate: the median of a Rayleigh distribution is 1.1774 of it."""
    return float(np.median(norms)) / 1.1774


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


def _levenberg_marquardt(objective: _Objective, state: State, robust: bool) -> tuple[State, int]:
    """The optimum, and the number of iterations; where `robust`, Cauchy's scale follows the residuals."""
    norms, damping = objective.norms(state), 1e-4 if robust else 1e-6
    for iteration in range(1, MAX_ITERATIONS + 1):
        if robust:
            scale = CAUCHY_SCALE * max(_spread(norms.observation), 1.0)
            objective = replace(objective, observation_scale=scale, interval_scale=CAUCHY_SCALE)
        before = _Step(state, norms, objective.cost(norms), damping)
        step = _descend(objective, before)
        if step is None:
            return state, iteration
        state, norms, damping = step.state, step.norms, max(step.damping / 10, MIN_DAMPING)
        tolerance = ROBUST_TOLERANCE if robust else TOLERANCE
        if before.cost - step.cost < tolerance * before.cost + ABSOLUTE_TOLERANCE:
            return state, iteration
    return state, MAX_ITERATIONS


def _profile(objective: _Objective, state: State) -> State | None:
    """The state at which the cameras fit the observations best, with the motion that is optimal for these cameras, by
    Gauss-Newton; None where it does not converge."""
    norms = objective.norms(state)
    for _ in range(MAX_PROFILED_STEPS):
        try:
            steps = profile_motion(objective.linearize(state, norms)).step(objective.problem, state)
        except np.linalg.LinAlgError:
            return None
        stepped = _step_profiled(objective, state, norms, steps[:2])
        if stepped is None:
            return None
        state, norms = stepped
        if steps[2] < PROFILED_TOLERANCE:
            return state
    return None


def _step_profiled(
    objective: _Objective, state: State, norms: ErrorNorms, steps: tuple[Array, Array]
) -> tuple[State, ErrorNorms] | None:
    """Take the `steps` of cameras and motion, or a part of them; None where the cost grows much with all parts."""
    most = MAX_GROWTH * objective.cost(norms) + 1
    for share in 0.5 ** np.arange(MAX_HALVINGS):
        try:
            moved = objective.problem.retract(state, share * steps[0], share * steps[1])
            moved = locate(objective.problem, moved, objective.weights.background)
            after = objective.norms(moved)
            if objective.cost(after) < most:
                return moved, after
        except ValueError:  # Lens: impossible parameters
            pass
    return None


def _descend(objective: _Objective, before: _Step) -> _Step | None:
    """The first step that does not increase the cost, damping ever more; None where there is none."""
    system, damping = objective.linearize(before.state, before.norms), before.damping
    while damping <= MAX_DAMPING:
        try:
            state = objective.problem.retract(before.state, *solve_step(system, damping))
            state = locate(objective.problem, state, objective.weights.background)
            norms = objective.norms(state)
            if (cost := objective.cost(norms)) <= before.cost:
                return _Step(state, norms, cost, damping)
        except (RuntimeError, ValueError):  # a nearly singular system; Lens: impossible parameters
            pass
        damping *= 10
    return None
