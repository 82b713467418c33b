# SPDX-License-Identifier: BSD-3-Clause
"""Adjusts a rough rig in stages: robustly on few frame sets, then exactly on more, with the clocks that these show."""

from dataclasses import dataclass, replace

import numpy as np

from calib.errors import CalibrationError
from calib.rig.camera import LENS, POSE
from calib.wand.bundle_adjustment.clock_model import (
    ClockModel,
    choose_clocks,
    clock_candidates,
    with_readout_times,
)
from calib.wand.bundle_adjustment.covariance import inflate_covariance
from calib.wand.bundle_adjustment.disc_centres import with_disc_centres
from calib.wand.bundle_adjustment.lens_prior import estimate_lens_priors
from calib.wand.bundle_adjustment.optimizer import Adjusted, adjust, optimize, optimize_robustly
from calib.wand.bundle_adjustment.problem import (
    Estimate,
    State,
    WandObservations,
)
from calib.wand.bundle_adjustment.problem_setup import LabeledRecording, add_background, build_problem
from calib.wand.quality.checks import check_agreement, check_clocks, check_lenses, check_sizes, check_spacing
from calib.wand.quality.held_out import triangulated_residuals
from calib.wand.report import Validation
from calib.wand.trajectory import acceleration_density
from camera_node.foundation.arrays import Array, Mask

COARSE_SETS, FINE_SETS = 250, 1000  # frame sets of either stage
MAX_MEASURED = 20_000  # detections whose residuals are stated
RUN, PARTS = 8, 5  # of this many parts of a recording, runs of consecutive instants, one is held out


@dataclass(frozen=True, slots=True)
class RoughRig:
    """The start of an adjustment.

    Attributes:
        cameras: (C, 4, 4) T_world_cam.
        offset_s: (C,) true time = stamp + offset.
        metric: whether the start has the world's scale.
        distance: two cameras and their measured distance, which gives the scale where the wand has no length.
    """

    cameras: Array
    offset_s: Array
    metric: bool
    distance: tuple[int, int, float] | None = None


@dataclass(frozen=True, slots=True)
class Solution:
    """The adjusted rig, and its observations of the discs' own centres.

    Attributes:
        given: residuals of all detections of the recording, whether the adjustment used them or not.
        held_out: residuals of a fifth of the instants, at the rig adjusted without these.
        rejected_px: (r,) distances of the rejected observations from where the other cameras see the marker, pixels;
            NaN where none does.
    """

    adjusted: Adjusted
    observations: WandObservations
    given: Validation | None = None
    held_out: Validation | None = None
    rejected_px: Array | None = None


def adjust_rig(recording: LabeledRecording, rough: RoughRig) -> Solution:
    """Adjust a rough rig by a recording of the wand.

    Where nothing gives the scale, the two cameras farthest apart are put 1 m apart.

    Raises:
        CalibrationError: the wand's lengths do not fit the observations or the roundels' sizes.
        CameraFault: a camera's lens differs from its file, or its observations contradict those of the others.
    """
    rough = scale_rig(rough)
    coarse = adjust_coarsely(recording, rough)
    check_lenses(recording.names, coarse)
    check_clocks(recording.names, coarse)
    coarse = inflate_covariance(coarse)
    clocks = choose_clocks(coarse)
    fine = _prepare_fine(recording, rough, coarse, clocks)
    solution = _adjust_finely(fine, coarse.inflation)
    check_agreement(recording.names, solution.adjusted, solution.observations)
    if rough.metric:
        check_sizes(recording.wand, solution.adjusted, solution.observations)
        check_spacing(recording.wand, solution.adjusted, solution.observations)
    solution = replace(solution, adjusted=inflate_covariance(solution.adjusted))
    return _validate(recording, solution)


def _validate(recording: LabeledRecording, solution: Solution) -> Solution:
    """Measure the residuals of all detections, and of detections that are held out.

    Of recordings with very many detections, those in the frame sets of the adjustment are measured.
    """
    adjusted, observations = solution.adjusted, solution.observations
    measured = np.ones(len(recording.detections), bool)
    if len(measured) > MAX_MEASURED:
        measured = np.isin(np.arange(len(measured)), observations.row)
    corrected = recording.with_centres(observations.row, observations.uv).select(measured)
    given = triangulated_residuals(corrected, adjusted.state)
    residuals = np.full(len(measured), np.nan)
    residuals[measured] = np.linalg.norm(given.pixels, axis=1)
    run = recording.timing.instants(corrected.detections.t_s) // RUN
    last = np.zeros(len(measured), bool)
    last[measured] = run % PARTS == PARTS - 1
    held_out = corrected.select(last[measured])
    without = _adjust_without(solution, last) if last.any() else None
    return replace(
        solution,
        given=given.summary(),
        held_out=triangulated_residuals(held_out, without).summary() if without is not None else None,
        rejected_px=residuals[observations.row[~adjusted.used]],
    )


def _adjust_without(solution: Solution, held_out: Mask) -> State | None:
    """The state adjusted without some detections (n,) of the recording, from the state with them; None where fewer than
    two frame sets remain."""
    whole = Estimate(solution.adjusted.problem, solution.adjusted.state, solution.observations)
    part = whole.select(~held_out[solution.observations.row])
    return None if part is None else optimize(part.problem, part.observations, part.state)


def scale_rig(rough: RoughRig) -> RoughRig:
    """The rig scaled to the measured distance, or to 1 m between the farthest cameras if it has no scale."""
    if rough.distance is None and rough.metric:
        return rough
    a, b, wanted = rough.distance or (*_farthest(rough.cameras)[:2], 1.0)
    cameras = rough.cameras.copy()
    cameras[:, :3, 3] *= wanted / np.linalg.norm(cameras[a, :3, 3] - cameras[b, :3, 3])
    return replace(rough, cameras=cameras)


def _farthest(cameras: Array) -> tuple[int, int, float]:
    gaps = np.linalg.norm(cameras[:, None, :3, 3] - cameras[None, :, :3, 3], axis=2)
    a, b = np.unravel_index(int(gaps.argmax()), gaps.shape)
    return int(a), int(b), float(gaps[a, b])


def _build(recording: LabeledRecording, rough: RoughRig, budget: int) -> Estimate:
    start = build_problem(recording, rough.cameras, rough.offset_s, budget)
    if start is None:
        raise CalibrationError(
            "the wand's lengths do not fit the detections; check the wand file, and that the rig file has the "
            "intrinsics of these cameras"
        )
    if len(start.problem.wand.lengths):
        return start
    distance = rough.distance or _farthest(rough.cameras)
    return replace(start, problem=replace(start.problem, fixed_distance=distance))


def adjust_coarsely(recording: LabeledRecording, rough: RoughRig, budget: int = COARSE_SETS) -> Adjusted:
    """Adjust poses, clocks and lenses on about `budget` frame sets, after a robust optimization of poses and clocks."""
    start = _build(recording, rough, budget)
    problem = start.problem.with_free(POSE, *clock_candidates(recording.timing, start.problem))
    state = optimize_robustly(problem, start.observations, start.state)
    # Noise in the rough positions looks like acceleration: the first density makes the motion prior too weak, so the
    # motion absorbs noise and the residuals are too small.
    density = acceleration_density(problem.knot_s, state.motion[:, 0], recording.timing.gap_s)
    problem = replace(problem.with_free(problem.free, LENS), density=density)
    observations = with_disc_centres(problem, state, start.observations, recording.wand)
    return with_readout_times(adjust(problem, observations, state), observations, recording.timing)


def _prepare_fine(
    recording: LabeledRecording, rough: RoughRig, coarse: Adjusted, clocks: ClockModel
) -> Estimate:
    """The problem of the fine stage, from the coarse stage's cameras, lenses and clocks."""
    lenses = [coarse.state.lens(k, lens) for k, lens in enumerate(recording.lenses)]
    better = replace(rough, cameras=coarse.state.cameras, offset_s=clocks.clocks[:, 0])
    start = _build(recording.undistort_tracks(lenses), better, FINE_SETS)
    state = replace(start.state, clocks=clocks.clocks, lenses=coarse.state.lenses)
    density = acceleration_density(coarse.problem.knot_s, coarse.state.motion[:, 0], recording.timing.gap_s)
    problem = start.problem.with_free(POSE, LENS, *clocks.free)
    problem = replace(problem, density=density, drift_sigma=clocks.drift_sigma)
    observations = with_disc_centres(problem, state, start.observations, recording.wand)
    return add_background(recording, Estimate(problem, state, observations))


def _adjust_finely(fine: Estimate, inflation: float) -> Solution:
    """Adjust once with usual lens priors, estimate the lens priors from that, and adjust with these."""
    first = adjust(fine.problem, fine.observations, fine.state, rounds=1)
    problem = estimate_lens_priors(fine.problem, replace(first, inflation=inflation))
    return Solution(adjust(problem, fine.observations, first.state, profiled=True), fine.observations)
