# SPDX-License-Identifier: BSD-3-Clause
"""A camera's clock that jumps while the wand is waved: set by a time service, or by a driver that counts frames.

Before and after a jump, what one camera saw fits what the others saw at another shift of its stamps: the moment and
the two shifts that explain it best are sought among all (a change point by least absolute deviations: Bai 1995). To be
sure, this camera is adjusted once more as two, until and from that moment on, each with a place and a clock of its own:
the difference of their clocks is the jump, and its covariance says whether it is one.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from calib.rig.camera import DRIFT, LENS, OFFSET, POSE
from calib.wand.bundle_adjustment.covariance import camera_covariance, inflate_covariance
from calib.wand.bundle_adjustment.optimizer import Adjusted, adjust, optimize_robustly
from calib.wand.bundle_adjustment.problem import CRYSTAL_DRIFT, SLEWED_DRIFT, Problem, State, WandObservations
from calib.wand.bundle_adjustment.residuals import find_weights, whitened_errors
from camera_node.arrays import Array

# A jump that leaves neither of these has not touched the rig: rejected part of a camera's markers, and drift, s/s.
REJECTED, DRIFTS = 0.1, 5 * CRYSTAL_DRIFT
LATE = np.geomspace(1e-3, 0.4, 24)
SHIFTS = np.concatenate([-LATE[::-1], [0.0], LATE])  # seconds, that are tried
FAR = 100.0  # sigmas: what is farther off is as wrong
CHANCE = 1e-4  # probability below which a jump at any moment of any camera is none by chance
TWICE = 2.0  # by which the two ways to a jump may differ: it is none where they contradict each other
MOMENTS = 10  # on either side, in which the camera saw the wand: fewer place no camera


@dataclass(frozen=True, slots=True)
class ClockJump:
    """By how much a camera's stamps jump, ms, with standard deviation, and at which stamp, seconds from the
    first instant."""

    camera: str
    ms: float
    sigma_ms: float
    at_s: float

    def words(self) -> str:
        """What happened."""
        return (
            f"its clock jumps by {self.ms:+.1f} \N{PLUS-MINUS SIGN} {self.sigma_ms:.1f} ms at {self.at_s:.1f} s: see "
            "that nothing sets it and that no frames are dropped, and wave again"
        )

    def as_dict(self) -> dict[str, float]:
        """For the `calibration` map of `rig.yaml`."""
        return {"ms": round(self.ms, 2), "sigma": round(self.sigma_ms, 2), "at_s": round(self.at_s, 2)}


def find_jump(names: Sequence[str], adjusted: Adjusted, seen: WandObservations) -> ClockJump | None:
    """The clock that jumps; of several, that which spoils most; None where none does.

    Args:
        names: of the C cameras.
        adjusted, seen: an adjustment that ended, and its observations.
    """
    if not _suspicious(adjusted, seen):
        return None
    problem = adjusted.problem.with_free(POSE, OFFSET, LENS)  # a drift would take up half of a jump
    steady = replace(adjusted.state, clocks=adjusted.state.clocks * [1.0, 0.0])
    state = optimize_robustly(problem, seen, steady)
    changes = [_find_change(problem, seen, state, camera) for camera in problem.estimated_cameras()]
    change = max(changes, key=lambda change: change.gain)
    return _confirm(names, change, problem, seen, state) if change.gain else None


def _suspicious(adjusted: Adjusted, seen: WandObservations) -> bool:
    """Whether much of what a camera saw was rejected, or its clock drifts as none does that is left alone."""
    total = np.bincount(seen.camera, minlength=len(adjusted.problem.lenses))
    rejected = np.bincount(seen.camera[~adjusted.used], minlength=len(total)) / np.maximum(total, 1)
    drift = adjusted.state.clocks[:, 1]
    return bool(rejected.max() > REJECTED or np.abs(drift - np.median(drift)).max() > DRIFTS)


@dataclass(frozen=True, slots=True)
class _Change:
    """From which stamp on a camera's stamps fit at another shift, by how much it is larger, and what the summed
    deviations lose by it."""

    camera: int
    t_s: float
    by_s: float
    gain: float


def _find_change(problem: Problem, seen: WandObservations, state: State, camera: int) -> _Change:
    """Where this camera's shift would best change."""
    rows = seen.select(np.flatnonzero(seen.camera == camera))
    rows = rows.select(np.argsort(rows.t_s, kind="stable"))
    moments, first = np.unique(rows.t_s, return_index=True)
    moments, first = moments[MOMENTS:-MOMENTS], first[MOMENTS:-MOMENTS]
    if not len(moments):
        return _Change(camera, 0.0, 0.0, 0.0)
    off = np.cumsum(_deviations(problem, rows, state, camera), axis=1)
    before, after = off[:, first - 1], off[:, -1:] - off[:, first - 1]
    k = int((before.min(axis=0) + after.min(axis=0)).argmin())
    low, high = int(before[:, k].argmin()), int(after[:, k].argmin())
    gain = off[:, -1].min() - before[low, k] - after[high, k]
    return _Change(camera, float(moments[k]), float(SHIFTS[high] - SHIFTS[low]), float(gain))


def _deviations(problem: Problem, rows: WandObservations, state: State, camera: int) -> Array:
    """(SHIFTS, n) how far what one camera saw is from what is expected, sigmas, were its stamps shifted."""
    weights, off = find_weights(problem, rows, state), []
    for shift in SHIFTS:
        clocks = state.clocks.copy()
        clocks[camera, 0] += shift
        off.append(
            np.linalg.norm(whitened_errors(problem, rows, replace(state, clocks=clocks), weights), axis=1)
        )
    return np.minimum(off, FAR)


def _confirm(
    names: Sequence[str], change: _Change, problem: Problem, seen: WandObservations, state: State
) -> ClockJump | None:
    """Adjust the camera as two, that from the change on being the last."""
    from scipy.special import chdtrc

    camera, after = change.camera, len(names)
    twice = [*range(after), camera]
    clocks = state.clocks[twice]
    clocks[-1, 0] += change.by_s
    apart = replace(
        problem.with_free(problem.free, DRIFT),
        lenses=[problem.lenses[k] for k in twice],
        lens_sigma=problem.lens_sigma[twice],
        lens_sigma_claimed=None,
        estimated=problem.estimated and (*problem.estimated, after),
        drift_sigma=SLEWED_DRIFT,
    )
    later = (seen.camera == camera) & (seen.t_s >= change.t_s)
    seen = replace(seen, camera=np.where(later, after, seen.camera))
    begin = State(state.cameras[twice], clocks, state.lenses[twice], state.motion)
    parted = inflate_covariance(adjust(apart, seen, optimize_robustly(apart, seen, begin)))
    jump, variance = _difference(parted, camera, change.t_s)
    by_chance = chdtrc(1, jump**2 / variance) * len(seen)
    if by_chance > CHANCE or not 1 / TWICE < -jump / change.by_s < TWICE:
        return None
    return ClockJump(names[camera], 1e3 * jump, 1e3 * variance**0.5, change.t_s)


def _difference(parted: Adjusted, camera: int, at_s: float) -> tuple[float, float]:
    """By how much the stamps of `camera` are late from a moment on, where it is the last, seconds, and the variance."""
    since = np.array([1.0, at_s - parted.problem.middle_s])
    ends, by_clock = [camera, len(parted.problem.lenses) - 1], np.array([since, -since]).ravel()
    covariance = (
        camera_covariance(parted).of((*OFFSET, *DRIFT))[np.ix_(ends, range(2), ends, range(2))].reshape(4, 4)
    )
    return float(by_clock @ parted.state.clocks[ends].ravel()), float(by_clock @ covariance @ by_clock)
