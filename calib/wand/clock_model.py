# SPDX-License-Identifier: BSD-3-Clause
"""Which times of the cameras a recording shows: clock offsets, drifts, readout times of rolling shutters, and jumps.

A parameter that the recording does not show costs accuracy where the cameras share exact clocks or have global
shutters. docs/design/wand_adjustment.md, section 8, has the equations.

A clock may jump during the recording, set by a time service or a frame counter. Before and after a jump, one camera's
observations fit the others' at different shifts of its stamps. The jump's time and the two shifts are those that fit
best of all (a change point by least absolute deviations: Bai 1995). To confirm it, that camera is adjusted as two
cameras, before and after the jump, each with its own pose and clock: the jump is the difference of their clocks, and
its covariance gives its significance. A camera that moved differs in its pose instead, and that of equal poses or that
of equal clocks is the likelier hypothesis.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from calib.rig.camera import DRIFT, LENS, OFFSET, POSE, READOUT
from calib.rig.estimation import CHANCE, CLEAR, MARGIN
from calib.wand.bundle_adjustment.covariance import (
    camera_covariance,
    inverse_information,
)
from calib.wand.bundle_adjustment.optimizer import adjust, optimize_robustly, with_information
from calib.wand.bundle_adjustment.problem import (
    CRYSTAL_DRIFT,
    SLEWED_DRIFT,
    Adjusted,
    BackgroundPoints,
    Problem,
    State,
    WandObservations,
)
from calib.wand.bundle_adjustment.residuals import find_weights, whitened_errors
from calib.wand.detections import Timing
from calib.wand.wand_report import ClockJump
from camera_node.foundation.arrays import Array, Index
from camera_node.geometry.pose import invert, vector_from_rotation

# A jump that does not disturb the rig leaves neither: the rejected share of a camera's observations, and its drift,
# s/s.
MAX_REJECTED, MAX_DRIFT = 0.1, 5 * CRYSTAL_DRIFT
SHIFT_SIZES = np.geomspace(1e-3, 0.4, 24)
SHIFTS = np.concatenate([-SHIFT_SIZES[::-1], [0.0], SHIFT_SIZES])  # seconds, that are tried
MAX_DEVIATION = 100.0  # sigmas: larger ones count as this
AGREEMENT = 2.0  # factor within which the shift and the adjustment must agree on the jump
MIN_FRAMES = 10  # of the camera on either side of the jump: fewer do not determine its pose
NEAR_S = 3.0  # from the first time of a jump, within which the final one is searched


@dataclass(frozen=True, slots=True)
class ClockModel:
    """Groups of clock parameters that are free, (C, 3) their initial values, and the prior of the drift."""

    free: tuple[tuple[int, ...], ...]
    clocks: Array
    drift_sigma: float


def clock_candidates(timing: Timing) -> tuple[tuple[int, ...], ...]:
    """The clock parameters that a recording may show; readout times are added by `with_readout_times`."""
    return () if timing.synchronous else (OFFSET, DRIFT)


def choose_clocks(adjusted: Adjusted, timing: Timing) -> ClockModel:
    """Which of the free clock parameters the recording shows: all, where clocks were aligned by the motion. With an
    offset, the drift is free too: a clock that runs on its own drifts, though a short recording may not show it."""
    candidates = tuple(group for group in (OFFSET, DRIFT) if group[0] in adjusted.problem.free)
    shown = tuple(group for group in candidates if timing.aligned or _differ(adjusted, group))
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
    if timing.synchronous or not adjusted.converged:
        return adjusted
    cameras = list(adjusted.problem.estimated_cameras())
    problem = adjusted.problem.with_free(adjusted.problem.free, READOUT)
    predicted = with_information(adjusted, problem, observations)
    readout_s = _predict_readout(predicted)
    if not _has_readout(readout_s, predicted, timing):
        return adjusted
    clocks = adjusted.state.clocks.copy()
    clocks[cameras, 2] = readout_s
    found = adjust(problem, observations, replace(adjusted.state, clocks=clocks))
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
    possible = not timing.period_s or bool((total < timing.period_s + CLEAR * np.sqrt(np.diag(cov))).all())
    return possible and _is_significant(readout_s, cov, len(cameras), adjusted)


def find_jump(names: Sequence[str], adjusted: Adjusted, observations: WandObservations) -> ClockJump | None:
    """The clock jump that costs the fit most; None if no clock jumps.

    Args:
        names: of the C cameras.
        adjusted, observations: a converged adjustment.
    """
    if adjusted.problem.gap_s == 0 or not _is_suspicious(adjusted, observations):
        return None  # synchronous cameras have no clocks
    problem = adjusted.problem.with_free(POSE, OFFSET, LENS)  # a drift would absorb half of a jump
    steady = replace(adjusted.state, clocks=adjusted.state.clocks * [1.0, 0.0, 1.0])
    state = optimize_robustly(problem, observations, steady)
    changes = [_find_change(problem, observations, state, camera) for camera in problem.estimated_cameras()]
    change = max(changes, key=lambda change: change.gain)
    return _confirm(names, change, problem, observations, state) if change.gain else None


def _is_suspicious(adjusted: Adjusted, observations: WandObservations) -> bool:
    """Whether many of a camera's observations were rejected, or its clock drifts more than a free-running one."""
    total = np.bincount(observations.camera, minlength=len(adjusted.problem.lenses))
    rejected = np.bincount(observations.camera[~adjusted.used], minlength=len(total)) / np.maximum(total, 1)
    drift = adjusted.state.clocks[:, 1]
    return bool(rejected.max() > MAX_REJECTED or np.abs(drift - np.median(drift)).max() > MAX_DRIFT)


@dataclass(frozen=True, slots=True)
class _ChangePoint:
    """From stamp `t_s` on, a camera's shift is larger by `by_s`; this decreases the summed deviations by `gain`."""

    camera: int
    t_s: float
    by_s: float
    gain: float


def _find_change(problem: Problem, observations: WandObservations, state: State, camera: int) -> _ChangePoint:
    """The best change of one camera's shift."""
    rows, frames, first = _inner_frames(observations, camera)
    if not len(frames):
        return _ChangePoint(camera, 0.0, 0.0, 0.0)
    total = np.cumsum(_deviations(problem, rows, state, camera), axis=1)
    before, after = total[:, first - 1], total[:, -1:] - total[:, first - 1]
    k = int((before.min(axis=0) + after.min(axis=0)).argmin())
    low, high = int(before[:, k].argmin()), int(after[:, k].argmin())
    gain = total[:, -1].min() - before[low, k] - after[high, k]
    return _ChangePoint(camera, float(frames[k]), float(SHIFTS[high] - SHIFTS[low]), float(gain))


def _inner_frames(observations: WandObservations, camera: int) -> tuple[WandObservations, Array, Index]:
    """One camera's observations by time, the stamps (f,) of its frames but for the first and the last `MIN_FRAMES`, and
    the first observation (f,) of each."""
    rows = observations.select(np.flatnonzero(observations.camera == camera))
    rows = rows.select(np.argsort(rows.t_s, kind="stable"))
    frames, first = np.unique(rows.t_s, return_index=True)
    return rows, frames[MIN_FRAMES:-MIN_FRAMES], first[MIN_FRAMES:-MIN_FRAMES]


def _deviations(problem: Problem, rows: WandObservations, state: State, camera: int) -> Array:
    """(SHIFTS, n) deviations of one camera's observations in sigmas, for each shift of its stamps."""
    weights, deviations = find_weights(problem, rows, state), []
    for shift in SHIFTS:
        clocks = state.clocks.copy()
        clocks[camera, 0] += shift
        errors = whitened_errors(problem, rows, replace(state, clocks=clocks), weights)
        deviations.append(np.linalg.norm(errors, axis=1))
    return np.minimum(deviations, MAX_DEVIATION)


def _confirm(
    names: Sequence[str],
    change: _ChangePoint,
    problem: Problem,
    observations: WandObservations,
    state: State,
) -> ClockJump | None:
    """Adjust the camera as two, the one after the change being the last; None if the jump is not significant, or if the
    camera moved instead."""
    from scipy.special import chdtrc

    camera, after = change.camera, len(names)
    split = [*range(after), camera]
    clocks = state.clocks[split]
    clocks[-1, 0] += change.by_s
    two = replace(
        problem.with_free(problem.free, DRIFT),
        lenses=[problem.lenses[k] for k in split],
        lens_sigma=problem.lens_sigma[split],
        covariance_lens_sigma=None,
        estimated=problem.estimated and (*problem.estimated, after),
        drift_sigma=SLEWED_DRIFT,
        background=BackgroundPoints.none(),
    )
    start = State(state.cameras[split], clocks, state.lenses[split], state.motion, state.shape)
    # The time is found along the motion that the other cameras show: that of both parts of the clock bends to the first
    # one.
    is_near = (observations.camera == camera) & (np.abs(observations.t_s - change.t_s) < NEAR_S)
    shown = observations.select(np.flatnonzero(~is_near))
    start = optimize_robustly(two, _split(shown, camera, change.t_s, after), start)
    at_s = _find_boundary(two, observations, start, camera)
    adjusted = adjust(two, _split(observations, camera, at_s, after), start)
    jump, variance = _clock_difference(adjusted, camera, at_s)
    by_chance = chdtrc(1, jump**2 / variance) * len(observations)
    if by_chance > CHANCE or not 1 / AGREEMENT < -jump / change.by_s < AGREEMENT:
        return None
    # What the hypothesis of equal clocks adds to the squared deviations of the recording, less what equal poses add.
    margin = jump**2 / variance - _squared_motion(adjusted, camera)
    if margin < -MARGIN:
        return None
    return ClockJump(names[camera], 1e3 * jump, 1e3 * variance**0.5, at_s, or_moved=margin < MARGIN)


def _split(observations: WandObservations, camera: int, at_s: float, new: int) -> WandObservations:
    """The observations with those of a camera from stamp `at_s` on under the number of a `new` one."""
    later = (observations.camera == camera) & (observations.t_s >= at_s)
    return replace(observations, camera=np.where(later, new, observations.camera))


def _find_boundary(problem: Problem, observations: WandObservations, state: State, camera: int) -> float:
    """The stamp before which a camera's observations fit its own state, and after which they fit the last camera's."""
    rows, frames, first = _inner_frames(observations, camera)
    deviations = []
    for of in (camera, len(problem.lenses) - 1):
        as_camera = replace(rows, camera=np.full(len(rows), of))
        errors = whitened_errors(problem, as_camera, state, find_weights(problem, as_camera, state))
        deviations.append(np.minimum(np.linalg.norm(errors, axis=1), MAX_DEVIATION))
    gain = np.cumsum(deviations[0] - deviations[1])
    return float(frames[gain[first - 1].argmin()])


def _clock_difference(adjusted: Adjusted, camera: int, at_s: float) -> tuple[float, float]:
    """The offset of `camera`'s clock less that of the last camera's at a stamp, seconds, and its variance."""
    since = np.array([1.0, at_s - adjusted.problem.middle_s])
    ends, by_clock = [camera, len(adjusted.problem.lenses) - 1], np.array([since, -since]).ravel()
    joint = camera_covariance(adjusted).of((*OFFSET, *DRIFT))
    covariance = joint[np.ix_(ends, range(2), ends, range(2))].reshape(4, 4)
    return float(by_clock @ adjusted.state.clocks[ends, :2].ravel()), float(by_clock @ covariance @ by_clock)


def _squared_motion(adjusted: Adjusted, camera: int) -> float:
    """Squared Mahalanobis distance of the poses of `camera` and of the last camera."""
    ends = [camera, len(adjusted.problem.lenses) - 1]
    before, after = adjusted.state.cameras[ends]
    change = invert(before) @ after
    difference = np.append(vector_from_rotation(change[:3, :3]), change[:3, 3])
    joint = camera_covariance(adjusted).of(POSE)[np.ix_(ends, range(6), ends, range(6))]
    sign = np.array([1.0, -1.0])
    covariance = np.einsum("a,apbq,b->pq", sign, joint, sign)
    return float(difference @ np.linalg.solve(covariance, difference))
