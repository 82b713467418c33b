# SPDX-License-Identifier: BSD-3-Clause
"""Bundle adjustment of cameras, their clocks and a waved wand, every frame at its own capture time.

Unknown are the cameras' poses and time offsets and the wand's motion (`trajectory`); measured are roundel centres, the
wand's lengths and, weakly, that a hand moves smoothly. Each iteration linearises all observations in numpy, once; GTSAM
eliminates the sparse system (`linearisation`). Robust by iteratively reweighted least squares: Cauchy's weights at a
scale that the residuals themselves give, then plain least squares without what the statistics reject.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calib.linearisation import Linearisation, Observations, Problem, State, unobserved

Array = NDArray[np.float64]

CAUCHY = 2.3849  # 95 % efficient on normal residuals
REJECT = 4.5  # sigmas: one true observation in 25,000 is beyond (chi-square, 2 degrees)
MAX_ITERATIONS = 60
MIN_DAMPING = 1e-9
NOTHING = (
    1e-4  # gained in half of chi-square: every parameter is within a hundredth of its standard deviation
)


@dataclass(frozen=True, slots=True)
class Adjusted:
    """The best state.

    Attributes:
        problem: what was adjusted, with the parameters that were sought.
        state: cameras, clocks, lenses and motion.
        used: (n,) the observations that were not rejected.
        residuals: (n, 2) seen less expected, pixels, of all observations.
        scale: what the residuals are over what their covariances claim; covariances are grown by it if above 1.
        information: (C d, C d) of the cameras' free parameters, poses in their own frames, rotation then translation;
            its null space is the choice of the world, and of the clock that all others are compared with.
        iterations: of all rounds together.
    """

    problem: Problem
    state: State
    used: NDArray[np.bool_]
    residuals: Array
    scale: float
    information: Array
    iterations: int

    def joint_covariance(self) -> Array:
        """(C, d, C, d) covariance of all free parameters, the world being where the cameras themselves are on average,
        and the time what their clocks say on average (inner constraints; Triggs et al., Bundle Adjustment, section
        9.3)."""
        gauge = unobserved(self.state, self.problem.free)
        rest = np.linalg.svd(gauge)[0][:, gauge.shape[1] :]
        full = np.asarray(rest @ np.linalg.inv(rest.T @ self.information @ rest) @ rest.T, float)
        count, d = len(self.state.cameras), len(self.problem.free)
        return full.reshape(count, d, count, d)

    def covariance(self, parameters: tuple[int, ...]) -> Array:
        """(C, p, C, p) that of some of a camera's parameters; zero where they were not sought."""
        full = np.zeros((len(self.state.cameras), len(parameters)) * 2)
        held = [k for k, p in enumerate(parameters) if p in self.problem.free]
        at = [self.problem.free.index(parameters[k]) for k in held]
        joint = self.joint_covariance()
        full[np.ix_(range(len(full)), held, range(len(full)), held)] = joint[:, at][:, :, :, at]
        return full


def find_robustly(problem: Problem, observations: Observations, start: State) -> State:
    """The state that most observations agree to, from a rough start."""
    every = Linearisation(problem, observations)
    every.weigh(start)
    return _descend(every, start, robust=True)[0]


def adjust(problem: Problem, observations: Observations, start: State) -> Adjusted:
    """Least squares from a `start` that is nearly right; gross outliers are rejected by the statistics of residuals."""
    every, state, rounds = Linearisation(problem, observations), start, 0
    used = np.zeros(len(observations), bool)
    for _ in range(5):
        every.weigh(state)
        norms = np.linalg.norm(every.whitened(state), axis=1)
        scale = _spread(norms[used] if used.any() else norms)
        keep = norms < REJECT * max(scale, 1.0)
        if (keep == used).all():
            break
        used = keep
        kept = Linearisation(problem, observations.select(used))
        kept.weigh(state)
        state, more = _descend(kept, state, robust=False)
        rounds += more
    kept = Linearisation(problem, observations.select(used))
    kept.weigh(state)
    scale = _variance_factor(kept, state)
    information = kept.camera_information(state) / max(scale, 1.0) ** 2
    return Adjusted(problem, state, used, every.residuals(state), scale, information, rounds)


def _spread(norms: Array) -> float:
    """Robust standard deviation of one coordinate: the median of a Rayleigh distribution is 1.1774 of it."""
    return float(np.median(norms)) / 1.1774


def _variance_factor(linearisation: Linearisation, state: State) -> float:
    """Square root of chi-square by degrees of freedom: those of the residuals, less the free ones of cameras and of the
    wand's places; velocities are mostly fixed by the prior that brings as many equations."""
    problem, residuals = linearisation.problem, linearisation.whitened(state)
    wand = problem.wand
    seen = len(np.unique(linearisation.observations.knot))
    free = seen * (3 * len(wand.basis) - len(wand.lengths)) + len(problem.free) * len(problem.lenses) - 6
    return float(np.sqrt((residuals**2).sum() / max(residuals.size - free, residuals.size / 10)))


def _descend(linearisation: Linearisation, state: State, robust: bool) -> tuple[State, int]:
    """Levenberg-Marquardt; with `robust`, Cauchy's weights at the scale of the current residuals."""
    damping = 1e-4 if robust else 1e-6
    for iteration in range(1, MAX_ITERATIONS + 1):
        norms = np.linalg.norm(linearisation.whitened(state), axis=1)
        scale = CAUCHY * max(_spread(norms), 1.0) if robust else np.inf
        before = linearisation.cost(state, scale)
        linearisation.relinearise(state, 1 / (1 + (norms / scale) ** 2))
        while True:
            try:
                trial = state.moved(*linearisation.solve(damping))
                if (after := linearisation.cost(trial, scale)) <= before:
                    break
            except RuntimeError:  # GTSAM's word for a system too near to singular
                pass
            damping *= 10
            if damping > 1e6:
                return state, iteration
        state, damping = trial, max(damping / 10, MIN_DAMPING)
        if before - after < (1e-3 if robust else 1e-6) * before + NOTHING:
            return state, iteration
    return state, MAX_ITERATIONS
