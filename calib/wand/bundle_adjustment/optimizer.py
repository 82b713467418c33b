# SPDX-License-Identifier: BSD-3-Clause
"""Bundle adjustment of cameras, their clocks and a waved wand, every frame at its own capture time.

Unknown are the cameras' poses and time offsets and the wand's motion (`trajectory`); measured are roundel centres, the
wand's lengths and, weakly, that a hand moves smoothly. Each iteration linearises all observations in numpy, once; GTSAM
eliminates the sparse system (`linearisation`). Robust by iteratively reweighted least squares: Cauchy's weights at a
scale that the residuals themselves give, then plain least squares without what the statistics reject.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from calib.wand.bundle_adjustment.gtsam_step import solve
from calib.wand.bundle_adjustment.linear_system import Linearisation
from calib.wand.bundle_adjustment.problem import Problem, State, WandObservations, unobserved
from calib.wand.bundle_adjustment.schur_complement import marginalise
from camera_node.arrays import Array, Mask

CAUCHY = 2.3849  # 95 % efficient on normal residuals
REJECT = 4.5  # sigmas: one true observation in 25,000 is beyond (chi-square, 2 degrees)
BREAK = 4.0  # sigmas, over all coordinates: the hand was knocked, or frames are missing from the count
MAX_ITERATIONS = 60
ROUNDS = 5
MIN_DAMPING = 1e-9
ROUGHLY, NOTHING = 5e-3, 1e-4  # of the cost: gained by a step that is the last
TINY = 1e-4  # of half of chi-square


@dataclass(frozen=True)
class Adjusted:
    """The best state.

    Attributes:
        problem: what was adjusted, with the parameters that were sought.
        state: cameras, clocks, lenses and motion.
        used: (n,) the observations that were not rejected.
        residuals: (n, 2) seen less expected, pixels, of all observations.
        scale: what the residuals are over what their covariances claim; all covariances are scaled by it.
        information: (S d, S d) of the S sought cameras' free parameters, poses in their own frames, rotation then
            translation, by what was seen at the noise it claims and by what was known before; its null space is the
            choice of the world, and of the clock that all others are compared with.
        scores: (L, S d) gradients, by interval between knots, of what was seen.
        iterations: of all rounds together.
        dependence: by what covariances, beside `scale`, are widened because errors of neighbouring moments are alike
            (`calib.wand.bundle_adjustment.dependence`).
    """

    problem: Problem
    state: State
    used: Mask
    residuals: Array
    scale: float
    information: Array
    scores: Array
    iterations: int
    dependence: float = 1.0

    @cached_property
    def joint_covariance(self) -> Array:
        """(C, d, C, d) covariance of all free parameters, the world being where the cameras themselves are on average,
        and the time what their clocks say on average (inner constraints; Triggs et al., Bundle Adjustment, section
        9.3). Where only some cameras were sought, it is theirs in the world of the others, which are taken as known."""
        by_prior = self.by_prior()
        return np.asarray(self.by_noise() + np.einsum("cpm,eqm->cpeq", by_prior, by_prior), float)

    def by_noise(self) -> Array:
        """(C, d, C, d) the part of it that comes from the noise of what was seen, as this turned out."""
        inverse, root = self.inverse(), self._prior_root()
        pulled = inverse * root
        return self._among_all(self.scale**2 * self.dependence * (inverse - pulled @ pulled.T), 2)

    def by_prior(self) -> Array:
        """(C, d, S d) the other part, P P^T: what each parameter is off by where another, which the last axis counts,
        is off by its doubt from what was given, and is held there. More of the same waving would not change it."""
        root, sought = self._prior_root(), list(self.problem.cameras())
        doubts = np.where(root > 0, self.problem.doubt()[sought].ravel(), 0.0)
        return np.asarray(self._among_all(self.inverse() * (root**2 * doubts), 1), float)

    def inverse(self) -> Array:
        """(S d, S d) inverse of the information on what is observed."""
        if self.problem.sought is not None:
            return np.asarray(np.linalg.inv(self.information), float)
        gauge = unobserved(self.state, self.problem.free)
        rest = np.linalg.svd(gauge)[0][:, gauge.shape[1] :]
        return np.asarray(rest @ np.linalg.inv(rest.T @ self.information @ rest) @ rest.T, float)

    def fixed_by_data(self) -> float:
        """The number of parameters that what was seen fixes; those that the prior alone fixes do not count."""
        return float(np.trace(self.inverse() @ (self.information - np.diag(self._prior_root() ** 2))))

    def _prior_root(self) -> Array:
        """(S d,) square root of the information that was there before."""
        return 1 / self.problem.prior_sigma()[list(self.problem.cameras())].ravel()

    def _among_all(self, part: Array, axes: int) -> Array:
        """Rows (and columns, of two `axes`) of the sought cameras among those of all; zero for the others."""
        count, d, sought = len(self.state.cameras), len(self.problem.free), list(self.problem.cameras())
        full = np.zeros((count, d, count, d)[: 2 * axes] + part.shape[axes:])
        split = part.reshape((len(sought), d, len(sought), d)[: 2 * axes] + part.shape[axes:])
        full[np.ix_(*[sought, range(d)] * axes)] = split
        return full

    def covariance(self, parameters: tuple[int, ...]) -> Array:
        """(C, p, C, p) that of some of a camera's parameters; zero where they were not sought."""
        full = np.zeros((len(self.state.cameras), len(parameters)) * 2)
        held = [k for k, p in enumerate(parameters) if p in self.problem.free]
        at = [self.problem.free.index(parameters[k]) for k in held]
        joint = self.joint_covariance
        full[np.ix_(range(len(full)), held, range(len(full)), held)] = joint[:, at][:, :, :, at]
        return full


def find_robustly(problem: Problem, observations: WandObservations, start: State) -> State:
    """The state that most observations agree to, from a rough start."""
    every = Linearisation(problem, observations)
    every.weigh(start)
    return _descend(every, start, robust=True)[0]


def adjust(problem: Problem, observations: WandObservations, start: State, rounds: int = ROUNDS) -> Adjusted:
    """Least squares from a `start` that is nearly right; gross outliers are rejected by the statistics of residuals,
    until these are the same again, or in so many `rounds`."""
    every, state, iterations = Linearisation(problem, observations), start, 0
    used, broken = np.zeros(len(observations), bool), np.zeros(len(problem.knot_s) - 1, bool)
    for _ in range(rounds):
        every.weigh(state)
        errors = every.errors(state)
        keep = errors.seen < REJECT * max(_spread(errors.seen[used] if used.any() else errors.seen), 1.0)
        torn = errors.strain > BREAK
        if (keep == used).all() and (torn == broken).all():
            break
        used, broken = keep, torn
        state, more = _descend(every.select(used, broken), state, robust=False)
        iterations += more
    else:
        every.weigh(state)
    kept = every.select(used, broken)
    kept.relinearise(state)
    cameras, scale = marginalise(kept), _variance_factor(kept, state)
    return Adjusted(
        problem, state, used, every.residuals(state), scale, cameras.information, cameras.scores, iterations
    )


def _spread(norms: Array) -> float:
    """Robust standard deviation of one coordinate: the median of a Rayleigh distribution is 1.1774 of it."""
    return float(np.median(norms)) / 1.1774


def _variance_factor(linearisation: Linearisation, state: State) -> float:
    """Square root of chi-square by degrees of freedom: of all that is measured, and that is known of the motion, less
    the parameters. Of the latter all but a few velocities at gaps are fixed."""
    problem = linearisation.problem
    B, knots, linked = len(problem.wand.basis), len(problem.knot_s), linearisation.linked()
    equations = 2 * len(linearisation.observations) + 6 * B * linked + len(problem.wand.lengths) * knots
    known = np.isfinite(problem.prior_sigma()).sum()
    free = 6 * B * knots + len(problem.free) * len(problem.lenses) - 6 - known
    return float(
        np.sqrt(2 * linearisation.errors(state).cost(np.inf, np.inf) / max(equations - free, equations / 10))
    )


def _descend(linearisation: Linearisation, state: State, robust: bool) -> tuple[State, int]:
    """Levenberg-Marquardt; with `robust`, Cauchy's weights at the scale of the current residuals."""
    damping, slack = (1e-4, CAUCHY) if robust else (1e-6, np.inf)
    errors = linearisation.errors(state)
    for iteration in range(1, MAX_ITERATIONS + 1):
        scale = CAUCHY * max(_spread(errors.seen), 1.0) if robust else np.inf
        before = errors.cost(scale, slack)
        weights = (
            1 / (1 + (part / limit) ** 2) for part, limit in ((errors.seen, scale), (errors.strain, slack))
        )
        linearisation.relinearise(state, *weights)
        while True:
            try:
                trial = linearisation.problem.moved(state, *solve(linearisation, damping))
                moved = linearisation.errors(trial)
                if (after := moved.cost(scale, slack)) <= before:
                    break
            except (RuntimeError, ValueError):  # GTSAM's word for nearly singular, and a lens that none is
                pass
            damping *= 10
            if damping > 1e6:
                return state, iteration
        state, errors, damping = trial, moved, max(damping / 10, MIN_DAMPING)
        if before - after < (ROUGHLY if robust else NOTHING) * before + TINY:
            return state, iteration
    return state, MAX_ITERATIONS
