# SPDX-License-Identifier: BSD-3-Clause
"""Decides which times of the cameras a recording shows: clock offsets, drifts, and readout times of rolling shutters.

A parameter that the recording does not show costs accuracy where the cameras share exact clocks or have global
shutters. docs/design/wand_adjustment.md, section 8, has the equations.
"""

from dataclasses import dataclass, replace

import numpy as np

from calib.rig.camera import DRIFT, OFFSET, READOUT
from calib.wand.bundle_adjustment.covariance import camera_covariance, inflation_factor, inverse_information
from calib.wand.bundle_adjustment.optimizer import Adjusted, adjust, with_information
from calib.wand.bundle_adjustment.problem import CRYSTAL_DRIFT, SLEWED_DRIFT, Problem, WandObservations
from calib.wand.timing import Timing
from camera_node.foundation.arrays import Array

MIN_DRIFT_S = 2.0  # shorter recordings do not show drift
POSSIBLE = 3.0  # standard deviations by which a readout time may exceed the time between two frames


@dataclass(frozen=True, slots=True)
class ClockModel:
    """Groups of clock parameters that are free, (C, 3) their initial values, and the prior of the drift."""

    free: tuple[tuple[int, ...], ...]
    clocks: Array
    drift_sigma: float


def clock_candidates(timing: Timing, problem: Problem) -> tuple[tuple[int, ...], ...]:
    """The clock parameters that a recording may show; readout times are added by `with_readout_times`."""
    if timing.synchronous:
        return ()
    return (OFFSET, DRIFT) if np.ptp(problem.knot_s) > MIN_DRIFT_S else (OFFSET,)


def choose_clocks(adjusted: Adjusted) -> ClockModel:
    """Which of the free clock parameters the recording shows. With an offset, the drift is free too: a clock that runs
    on its own drifts, though a short recording may not show it."""
    candidates = tuple(group for group in (OFFSET, DRIFT) if group[0] in adjusted.problem.free)
    shown = tuple(group for group in candidates if _differ(adjusted, group))
    free = candidates if OFFSET in shown else shown
    clocks = np.where([OFFSET in shown, DRIFT in shown, True], adjusted.state.clocks, 0.0)
    rolling = (READOUT,) if READOUT[0] in adjusted.problem.free else ()
    return ClockModel((*free, *rolling), clocks, SLEWED_DRIFT if DRIFT in shown else CRYSTAL_DRIFT)


def _differ(adjusted: Adjusted, group: tuple[int, ...]) -> bool:
    """Whether the clocks differ in a parameter, beside what they all share, which is the gauge."""
    values = adjusted.state.clocks[:, group[0] - OFFSET[0]]
    cov = camera_covariance(adjusted).of(group)[:, 0, :, 0]
    return _is_significant(values - values.mean(), cov, len(values) - 1, adjusted)


def _is_significant(values: Array, covariance: Array, degrees: int, adjusted: Adjusted) -> bool:
    """Whether values (C,) are not 0, by Schwarz's criterion (BIC) with the inflated covariance and the number of
    independent observations that it implies."""
    squared = values @ np.linalg.pinv(covariance, rcond=1e-9, hermitian=True) @ values
    return bool(squared > degrees * np.log(2 * adjusted.used.sum() / adjusted.inflation))


def with_readout_times(adjusted: Adjusted, observations: WandObservations, timing: Timing) -> Adjusted:
    """The adjustment with the readout times of rolling shutters free, if the recording shows these.

    They are predicted to first order, and adjusted where that prediction is significant. No camera takes longer to read
    an image than from one to the next: larger values explain something else, such as a clock that jumps.
    """
    if timing.synchronous:
        return adjusted
    adjusted = replace(adjusted, inflation=inflation_factor(adjusted))
    cameras = list(adjusted.problem.estimated_cameras())
    problem = adjusted.problem.with_free(adjusted.problem.free, READOUT)
    predicted = with_information(adjusted, problem, observations)
    readout_s = _predict_readout(predicted)
    if not _has_readout(readout_s, predicted, timing):
        return adjusted
    clocks = adjusted.state.clocks.copy()
    clocks[cameras, 2] = readout_s
    found = adjust(problem, observations, replace(adjusted.state, clocks=clocks), profiled=True)
    found = replace(found, inflation=inflation_factor(found))
    return found if _has_readout(found.state.clocks[cameras, 2], found, timing) else adjusted


def _predict_readout(adjusted: Adjusted) -> Array:
    """(S,) readout times of the estimated cameras after one Gauss-Newton step from a state without any."""
    d, at = len(adjusted.problem.free), adjusted.problem.free.index(READOUT[0])
    gradient = np.zeros_like(adjusted.scores[0])
    gradient[at::d] = adjusted.scores.sum(axis=0)[at::d]  # those of the other parameters are 0
    return (inverse_information(adjusted) @ gradient)[at::d]


def _has_readout(readout_s: Array, adjusted: Adjusted, timing: Timing) -> bool:
    """Whether readout times (S,) of the estimated cameras are significant and possible."""
    cameras = list(adjusted.problem.estimated_cameras())
    cov = camera_covariance(adjusted).of(READOUT)[:, 0, :, 0][np.ix_(cameras, cameras)]
    total = np.abs(adjusted.problem.readout_s[cameras] + readout_s)
    possible = not timing.period_s or bool((total < timing.period_s + POSSIBLE * np.sqrt(np.diag(cov))).all())
    return possible and _is_significant(readout_s, cov, len(cameras), adjusted)
