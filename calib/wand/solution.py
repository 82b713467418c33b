# SPDX-License-Identifier: BSD-3-Clause
"""From a rough rig to the adjusted one: robustly on few moments, then exactly on more; clocks only where they tell."""

from dataclasses import dataclass, replace

import numpy as np

from calib.errors import CalibrationError
from calib.rig.camera import DRIFT, LENS, OFFSET, POSE
from calib.wand.bundle_adjustment.covariance import camera_covariance, inflate_covariance
from calib.wand.bundle_adjustment.disc_centres import with_disc_centres
from calib.wand.bundle_adjustment.lens_prior import estimate_lens_priors
from calib.wand.bundle_adjustment.optimizer import Adjusted, adjust, optimize_robustly
from calib.wand.bundle_adjustment.problem import CRYSTAL_DRIFT, SLEWED_DRIFT, Problem, State, WandObservations
from calib.wand.quality.checks import check_agreement, check_lenses, check_sizes, check_spacing
from calib.wand.trajectory import acceleration_density
from calib.wand.wave import Wave
from camera_node.arrays import Array

FEW, MANY = 250, 800  # moments: to find the rig and the model, and to settle it
DRIFT_S = 2.0  # a recording must last to show clocks that drift


@dataclass(frozen=True, slots=True)
class Solution:
    """The adjusted rig of a wave, and the observations it stands on, with discs' own centres."""

    adjusted: Adjusted
    observations: WandObservations


def solve(
    wave: Wave, cameras: Array, offset_s: Array, metric: bool, known: tuple[int, int, float] | None = None
) -> Solution:
    """Adjust from a rough start.

    Args:
        wave: the recording.
        cameras: (C, 4, 4) T_world_cam; where nothing tells the scale, its two farthest cameras are set 1 m apart.
        offset_s: (C,) true time = stamp + offset.
        metric: whether the start has the world's scale.
        known: two cameras and the distance between them: the scale, where the wand has no length.

    Raises:
        CalibrationError: the wand's lengths fit nothing that was seen, or not its roundels' sizes.
        CameraFault: a camera's lens is not the one that was given, or what it saw contradicts the others.
    """
    if known is not None or not metric:
        a, b, wanted = known or (*_farthest(cameras)[:2], 1.0)
        cameras = cameras.copy()
        cameras[:, :3, 3] *= wanted / np.linalg.norm(cameras[a, :3, 3] - cameras[b, :3, 3])
    problem, state, observations = _around(wave, cameras, offset_s, FEW, known)
    clocks = (OFFSET, DRIFT) if np.ptp(problem.knot_s) > DRIFT_S else (OFFSET,)
    problem = problem.with_free(POSE, *clocks)
    state = optimize_robustly(problem, observations, state)
    # Of rough places, noise looks like acceleration: a weak prior takes it up, and what is left seems too precise.
    density = acceleration_density(problem.knot_s, state.motion[:, 0], wave.gap_s)
    problem = replace(problem.with_free(problem.free, LENS), density=density)
    centred = with_disc_centres(problem, state, observations, wave.wand.diameter_m)
    few = adjust(problem, centred, state)
    check_lenses(wave.names, few)
    judged = inflate_covariance(few)
    told = [part for part in clocks if _tells(judged, part)]
    free = (LENS, *(clocks if OFFSET in told else told))
    offset_s = few.state.clocks[:, 0] if OFFSET in told else np.zeros(len(cameras))
    drift = few.state.clocks[:, 1] if DRIFT in told else np.zeros(len(cameras))
    corrected = [few.state.lens(k, lens) for k, lens in enumerate(wave.lenses)]
    problem, start, observations = _around(
        wave.seen_through(corrected), few.state.cameras, offset_s, MANY, known
    )
    start = replace(start, clocks=np.column_stack([offset_s, drift]), lenses=few.state.lenses)
    density = acceleration_density(few.problem.knot_s, few.state.motion[:, 0], wave.gap_s)
    # A clock that runs on its own drifts, though a short wave may not show it.
    drift_sigma = SLEWED_DRIFT if DRIFT in told else CRYSTAL_DRIFT
    problem = replace(problem.with_free(POSE, *free), density=density, drift_sigma=drift_sigma)
    observations = with_disc_centres(problem, start, observations, wave.wand.diameter_m)
    first = replace(adjust(problem, observations, start, rounds=1), inflation=judged.inflation)
    adjusted = adjust(estimate_lens_priors(problem, first), observations, first.state)
    check_agreement(wave.names, adjusted, observations)
    if metric:
        check_sizes(wave.wand, adjusted, observations)
        check_spacing(wave.wand, adjusted, observations)
    return Solution(inflate_covariance(adjusted), observations)


def _around(
    wave: Wave, cameras: Array, offset_s: Array, budget: int, known: tuple[int, int, float] | None
) -> tuple[Problem, State, WandObservations]:
    found = wave.pose_problem(cameras, offset_s, budget)
    if found is None:
        raise CalibrationError(
            "the wand's lengths do not fit what the cameras saw: is the wand file right, "
            "and are the intrinsics those of these cameras?"
        )
    problem, state, observations = found
    if len(problem.wand.lengths) == 0:
        problem = replace(problem, fixed_distance=known or _farthest(cameras))
    return problem, state, observations


def _farthest(cameras: Array) -> tuple[int, int, float]:
    gaps = np.linalg.norm(cameras[:, None, :3, 3] - cameras[None, :, :3, 3], axis=2)
    a, b = np.unravel_index(int(gaps.argmax()), gaps.shape)
    return int(a), int(b), float(gaps[a, b])


def _tells(few: Adjusted, part: tuple[int, ...]) -> bool:
    """Whether the data want clocks apart: by more than Schwarz's criterion (BIC) asks of as many parameters, with the
    covariance, and the number of observations that count as news, that neighbouring errors leave (`inflation`)."""
    values = few.state.clocks[:, part[0] - OFFSET[0]]
    values = values - values.mean()
    cov = camera_covariance(few).of(part)[:, 0, :, 0]
    squared = values @ np.linalg.pinv(cov, rcond=1e-9, hermitian=True) @ values
    return bool(squared > (len(values) - 1) * np.log(2 * few.used.sum() / few.inflation))
