# SPDX-License-Identifier: BSD-3-Clause
"""Bundle adjustment of cameras and a waved wand, every frame at its own capture time.

Unknown are the cameras' poses and the wand's motion (`trajectory`); measured are roundel centres, the wand's lengths
and, weakly, that a hand moves smoothly. Each iteration linearises all observations in numpy, once; GTSAM eliminates the
sparse system (`linearisation`). Robust by iteratively reweighted least squares: Cauchy's weights at a scale that the
residuals themselves give, then plain least squares without what the statistics reject.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calib.errors import CalibrationError
from calib.linearisation import Linearisation, Observations, Problem, State, skew

Array = NDArray[np.float64]

CAUCHY = 2.3849  # 95 % efficient on normal residuals
REJECT = 4.5  # sigmas: one true observation in 25,000 is beyond (chi-square, 2 degrees)
MAX_ITERATIONS = 60
MIN_DAMPING = 1e-3


@dataclass(frozen=True, slots=True)
class Adjusted:
    """The best state.

    Attributes:
        state: cameras and motion.
        used: (n,) the observations that were not rejected.
        residuals: (n, 2) seen less expected, pixels, of all observations.
        scale: what the residuals are over what their covariances claim; covariances below are grown by it if above 1.
        information: (6C, 6C) of the cameras alone, their own frames, rotation then translation; its null space is the
            choice of the world.
        iterations: of all rounds together.
    """

    state: State
    used: NDArray[np.bool_]
    residuals: Array
    scale: float
    information: Array
    iterations: int

    def joint_covariance(self) -> Array:
        """(6C, 6C) covariance of all cameras, the world being where the cameras themselves are on average
        (inner constraints; Triggs et al., Bundle Adjustment, section 9.3)."""
        gauge = world_motions(self.state.cameras)
        rest = np.linalg.svd(gauge)[0][:, gauge.shape[1] :]
        return np.asarray(rest @ np.linalg.inv(rest.T @ self.information @ rest) @ rest.T, float)


def world_motions(cameras: Array) -> Array:
    """(6C, 6) how the cameras move in their own frames when the world turns and shifts: nothing observes it."""
    rows = []
    for T in cameras:
        R, p = T[:3, :3], T[:3, 3]
        rows.append(np.block([[R.T, np.zeros((3, 3))], [-R.T @ skew(p), R.T]]))
    return np.vstack(rows)


def adjust(problem: Problem, observations: Observations, start: State) -> Adjusted:
    """Bundle adjustment from `start`; gross outliers are rejected by the statistics of the residuals.

    Raises:
        CalibrationError: it does not converge.
    """
    every = Linearisation(problem, observations)
    state, rounds = _descend(every, start, robust=True)
    used = np.ones(len(observations), bool)
    for _ in range(4):
        norms = np.linalg.norm(every.whitened(state), axis=1)
        scale = _spread(norms[used])
        keep = norms < REJECT * max(scale, 1.0)
        state, more = _descend(Linearisation(problem, observations.select(keep)), state, robust=False)
        rounds += more
        if (keep == used).all():
            break
        used = keep
    kept = Linearisation(problem, observations.select(used))
    scale = _variance_factor(kept, state)
    information = kept.camera_information(state) / max(scale, 1.0) ** 2
    return Adjusted(state, used, every.residuals(state), scale, information, rounds)


def _spread(norms: Array) -> float:
    """Robust standard deviation of one coordinate: the median of a Rayleigh distribution is 1.1774 of it."""
    return float(np.median(norms)) / 1.1774


def _variance_factor(linearisation: Linearisation, state: State) -> float:
    """Square root of chi-square by degrees of freedom; velocities are not counted as free, which errs upwards."""
    problem, residuals = linearisation.problem, linearisation.whitened(state)
    wand = problem.wand
    free = len(problem.knot_s) * (3 * len(wand.basis) - len(wand.lengths)) + 6 * len(problem.lenses) - 6
    return float(np.sqrt((residuals**2).sum() / max(residuals.size - free, residuals.size / 10)))


def _descend(linearisation: Linearisation, state: State, robust: bool) -> tuple[State, int]:
    """Levenberg-Marquardt; with `robust`, Cauchy's weights at the scale of the current residuals."""
    damping = 10.0
    for iteration in range(1, MAX_ITERATIONS + 1):
        residuals = linearisation.whitened(state)
        norms = np.linalg.norm(residuals, axis=1)
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
            if damping > 1e12:
                return state, iteration
        state, damping = trial, max(damping / 10, MIN_DAMPING)
        if before - after < 1e-7 * before + 1e-12:
            return state, iteration
    if robust:
        return state, MAX_ITERATIONS
    raise CalibrationError(
        f"the adjustment did not converge in {MAX_ITERATIONS} iterations; are intrinsics and wand right?"
    )
