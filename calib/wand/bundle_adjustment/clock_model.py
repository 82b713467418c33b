# SPDX-License-Identifier: BSD-3-Clause
"""Decides which times of the cameras a recording shows: clock offsets, drifts, and readout times of rolling shutters.

A parameter that the recording does not show costs accuracy where the cameras share exact clocks or have global
shutters. docs/wand_adjustment.md, section 8, has the equations.
"""

from dataclasses import dataclass

import numpy as np

from calib.rig.camera import DRIFT, OFFSET, READOUT
from calib.wand.bundle_adjustment.covariance import camera_covariance
from calib.wand.bundle_adjustment.optimizer import Adjusted
from calib.wand.bundle_adjustment.problem import CRYSTAL_DRIFT, SLEWED_DRIFT, Problem
from calib.wand.timing import Timing
from camera_node.arrays import Array

MIN_DRIFT_S = 2.0  # shorter recordings do not show drift


@dataclass(frozen=True, slots=True)
class ClockModel:
    """Groups of clock parameters that are free, (C, 3) their initial values, and the prior of the drift."""

    free: tuple[tuple[int, ...], ...]
    clocks: Array
    drift_sigma: float


def clock_candidates(timing: Timing, problem: Problem) -> tuple[tuple[int, ...], ...]:
    """The clock parameters that a recording may show."""
    if timing.synchronous:
        return ()
    slow = (DRIFT,) if np.ptp(problem.knot_s) > MIN_DRIFT_S else ()
    return (OFFSET, *slow, READOUT)


def choose_clocks(adjusted: Adjusted) -> ClockModel:
    """Which of the free clock parameters the recording shows. With an offset, the drift is free too: a clock that runs
    on its own drifts, though a short recording may not show it."""
    times = _Estimates.of(adjusted)
    rolling = times.shows(READOUT)
    if not rolling:
        times = times.without_readout()
    candidates = tuple(group for group in (OFFSET, DRIFT) if group[0] in adjusted.problem.free)
    shown = tuple(group for group in candidates if times.shows(group))
    free = candidates if OFFSET in shown else shown
    clocks = np.where([OFFSET in shown, DRIFT in shown, rolling], times.values, 0.0)
    drift_sigma = SLEWED_DRIFT if DRIFT in shown else CRYSTAL_DRIFT
    return ClockModel((*free, READOUT) if rolling else free, clocks, drift_sigma)


@dataclass(frozen=True, slots=True)
class _Estimates:
    """Clock parameters of C cameras.

    Attributes:
        values: (C, 3) as in `State`.
        covariance: (C, 3, C, 3) of these, inflated.
        independent: number of independent coordinates that were observed.
    """

    values: Array
    covariance: Array
    independent: float

    @classmethod
    def of(cls, adjusted: Adjusted) -> "_Estimates":
        """The clock parameters of an adjustment; those that are not free are known to be 0."""
        covariance = camera_covariance(adjusted).of((*OFFSET, *DRIFT, *READOUT))
        return cls(adjusted.state.clocks, covariance, 2 * adjusted.used.sum() / adjusted.inflation)

    def shows(self, group: tuple[int, ...]) -> bool:
        """Whether the cameras differ in an offset or a drift, or have a readout time, by Schwarz's criterion (BIC)."""
        k = group[0] - OFFSET[0]
        values, degrees = self.values[:, k], len(self.values)
        if group != READOUT:  # what all clocks share is the gauge
            values, degrees = values - values.mean(), degrees - 1
        squared = values @ _inverse(self.covariance[:, k, :, k]) @ values
        return bool(squared > degrees * np.log(self.independent))

    def without_readout(self) -> "_Estimates":
        """The estimates given that all readout times are 0: of a Gaussian distribution, the conditional one."""
        count = len(self.values)
        of, by = np.arange(3 * count).reshape(count, 3)[:, :2].ravel(), np.arange(2, 3 * count, 3)
        joint, values = self.covariance.reshape(3 * count, 3 * count), self.values.ravel().copy()
        gain = joint[np.ix_(of, by)] @ _inverse(joint[np.ix_(by, by)])
        rest = np.zeros_like(joint)
        rest[np.ix_(of, of)] = joint[np.ix_(of, of)] - gain @ joint[np.ix_(by, of)]
        values[of] -= gain @ values[by]
        values[by] = 0.0
        return _Estimates(values.reshape(count, 3), rest.reshape(self.covariance.shape), self.independent)


def _inverse(covariance: Array) -> Array:
    return np.asarray(np.linalg.pinv(covariance, rcond=1e-9, hermitian=True), float)
