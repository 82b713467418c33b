# SPDX-License-Identifier: BSD-3-Clause
"""The wand calibration, top to bottom.

`calibrate` labels the detections, solves for the cameras, and concludes. To solve is: two-view geometry, an initial
rig, and its adjustment in stages (`adjust_rig`); without cameras that contradict the others, and again without
detections that are under the wrong camera. The first stage is robust on few frame sets, the second exact on more, with
the clocks that the first one shows; last, a part of the recording is held out.
"""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from calib.errors import CalibrationError, CameraFault
from calib.rig.camera import LENS, POSE
from calib.rig.rig import Rig
from calib.rig.wand_file import check_diameter
from calib.wand.alignment import Alignment, align_clocks
from calib.wand.bundle_adjustment.covariance import estimate_lens_priors
from calib.wand.bundle_adjustment.disc_centres import with_disc_centres
from calib.wand.bundle_adjustment.optimizer import adjust, optimize, optimize_robustly
from calib.wand.bundle_adjustment.problem import SLEWED_DRIFT, Adjusted, Estimate, State, WandObservations
from calib.wand.bundle_adjustment.problem_setup import add_background, build_problem
from calib.wand.clock_model import ClockModel, choose_clocks, clock_candidates, find_jump, with_readout_times
from calib.wand.conclusion import Placement, Solution, conclude, with_aligned_clocks
from calib.wand.detections import (
    MIN_COINCIDENT,
    WandRecording,
    coincident_share,
    count_frames,
    gather_background,
)
from calib.wand.focal_lengths import with_rough_focal_lengths
from calib.wand.initial_rig import (
    InitialRig,
    TwoViewGeometry,
    build_initial_rig,
    explain_disagreement,
    explain_failure,
    explain_unplaced,
    find_faults,
)
from calib.wand.labels import explain_codes, explain_wand, label_recording
from calib.wand.quality.checks import (
    check_lenses,
    check_motion,
    check_sizes,
    find_exchanges,
    triangulated_residuals,
)
from calib.wand.quality.contradictions import check_mirrored, check_residuals
from calib.wand.quality.wand_shape import check_shape
from calib.wand.recording_checks import check_cameras, check_inside, check_recording
from calib.wand.scale import Distance
from calib.wand.trajectory import acceleration_density
from calib.wand.wand_report import NOT_RECORDED, Exchange, WandCalibration
from camera_node.foundation.arrays import Array
from camera_node.geometry.body import Body
from camera_node.protocol.messages import Detections

MIN_REJECTED = 0.01  # share of rejected observations, from which they are explained
MAX_EXCHANGE_PASSES = 3  # each finds more, because the rig and the motion are better
BUDGET = 80  # instants that either model of synchronous cameras is fitted to
# Interpolation averages the noise of two frames, which by itself lowers residuals by up to 8 %: midway, the weights of
# the cubic polynomial give half of the variance to one of two cameras.
MIN_GAIN = 1.1  # ratio of the residuals without and with clock offsets, from which offsets are preferred
ROLLING = "the rows of rolling shutters are captured one after another, so the wand's motion matters"
COARSE_SETS, FINE_SETS = 250, 1000  # frame sets of either stage
MAX_MEASURED = 20_000  # detections whose residuals are stated
# Runs of consecutive instants are held out, or fitted, together, so that tracks can be interpolated within them: one in
# `PARTS` is held out.
RUN, PARTS = 8, 5
MIN_AGREEING = 0.5  # share of a camera's detections that must fit the rig


def calibrate(
    rig: Rig,
    wand: Body,
    messages: Sequence[Detections],
    distance: Distance | None = None,
    synchronous: bool = False,
    background: Sequence[Detections] = (),
) -> WandCalibration:
    """Estimate the poses and clocks of a rig's cameras from a wand recording.

    Args:
        rig: intrinsics of every camera; its poses are not used.
        wand: its markers; two or more give the scale, one gives it only by the size of the roundel.
        messages: detections of all cameras, in any order; the `id` of a roundel, if given, is its marker number.
        distance: measured between two cameras: the scale for a wand of one marker, else compared with the wand.
        synchronous: frames with equal stamps are simultaneous; without this, the recording decides.
        background: images of points beside the wand, at unknown positions, in the same clocks; the `id` of a roundel is
            the number of its point in all cameras.

    Returns:
        the rig with poses and time offsets of all cameras that could be placed, and the report.

    Raises:
        CalibrationError: the recording or the wand does not place two cameras, or most cameras contradict each other.
    """
    check_recording(rig, messages)
    check_cameras(rig, background, "the background points")
    check_inside(rig, background, "background points")
    check_diameter(wand, messages)
    if distance is not None:
        distance.check(list(rig.cameras))
    given = _Recorded(messages, background, synchronous)
    try:
        return _calibrate_by_any_clocks(rig, wand, given, distance)
    except CalibrationError as error:
        if difference := explain_wand(rig, wand, messages):
            raise CalibrationError(difference) from None
        if left_out := explain_codes(wand, messages):
            raise CalibrationError(f"{error}; {left_out}") from None
        raise


def _calibrate_by_any_clocks(
    rig: Rig, wand: Body, given: "_Recorded", distance: Distance | None
) -> WandCalibration:
    """Calibrate with the clocks as they are, or aligned by the motion if that places more cameras."""
    try:
        result = _calibrate(rig, wand, given, distance)
    except CalibrationError:
        if (aligned := _calibrate_aligned(rig, wand, given, distance)) is None:
            raise
        return aligned
    unplaced = any(why != NOT_RECORDED for why in result.report.unplaced.values())
    if not unplaced and not (np.abs(result.adjusted.state.clocks[:, 1]) > SLEWED_DRIFT).any():
        return result  # all cameras are placed, and no clock drifts as none of a computer does
    aligned = _calibrate_aligned(rig, wand, given, distance)
    return aligned if aligned is not None and len(aligned.names) >= len(result.names) else result


@dataclass(frozen=True, slots=True)
class _Recorded:
    """A recording, points beside the wand, whether its user declares it synchronous, and whether its clocks are
    aligned by the motion."""

    messages: Sequence[Detections]
    background: Sequence[Detections]
    synchronous: bool
    aligned: bool = False


def _calibrate_aligned(
    rig: Rig, wand: Body, given: _Recorded, distance: Distance | None
) -> WandCalibration | None:
    """Calibrate with the clocks aligned by the motion; None where they do not differ, or still no rig is found.

    Raises:
        CalibrationError: the clocks of cameras that are declared synchronous differ.
    """
    alignment = align_clocks(rig, wand, given.messages)
    if not alignment.maps:
        return None
    if given.synchronous:
        raise CalibrationError(
            f"the cameras are declared synchronous, but of {alignment.sentence()}; leave out --synchronised: then the "
            "offsets are estimated"
        )
    aligned = _Recorded(
        alignment.apply(given.messages), alignment.apply(given.background), False, aligned=True
    )
    try:
        result = _calibrate(rig, wand, aligned, distance)
    except CalibrationError as error:
        raise CalibrationError(f"of {alignment.sentence()}; with these clocks: {error}") from None
    result = with_aligned_clocks(result, alignment, alignment.start_s(given.messages))
    timing = f"{result.report.timing}; of {alignment.sentence()}"
    return replace(result, report=replace(result.report, timing=timing))


def _calibrate(rig: Rig, wand: Body, given: _Recorded, distance: Distance | None) -> WandCalibration:
    """Calibrate from rough focal lengths of unknown lenses, or from the given ones where these lead to no rig.

    Raises CalibrationError as `calibrate`, of a recording that fits the rig.
    """
    rough = with_rough_focal_lengths(rig, wand, given.messages)
    try:
        return _calibrate_from(rough, wand, given, distance)
    except CalibrationError:
        if rough is rig:
            raise
        return _calibrate_from(rig, wand, given, distance)


def _calibrate_from(rig: Rig, wand: Body, given: _Recorded, distance: Distance | None) -> WandCalibration:
    """Raises CalibrationError as `calibrate`, of a recording that fits the rig."""
    messages, background = given.messages, given.background
    recording, timing = label_by_timing(rig, wand, messages, given.synchronous)
    start_ns = min(message.t_ns for message in messages)
    lenses = [rig.cameras[name] for name in recording.names]
    beside = gather_background(background, recording.names, lenses, start_ns)
    own = replace(recording.timing, aligned=given.aligned)
    recording = replace(recording, background=beside, timing=own)
    if not len(recording.detections):
        raise CalibrationError(_explain_no_wand(recording))
    check_motion(recording.detections, recording.names, recording.lenses)
    placement, solution = _solve_without_exchanged(recording, distance)
    absent = {name: NOT_RECORDED for name in rig.cameras if name not in recording.names}
    placement = replace(placement, unplaced=placement.unplaced | absent, timing=timing)
    jump = find_jump(placement.recording.names, solution.adjusted, solution.observations)
    result = conclude(rig, solution, placement, jump)
    if solution.adjusted.problem.drift_sigma < SLEWED_DRIFT or any(m.sent_ns for m in messages):
        return result  # no drift, or camera nodes, whose clocks a server keeps
    return with_aligned_clocks(
        result, Alignment(start_ns + round(1e9 * recording.middle_s), {}), -recording.middle_s
    )


def _explain_no_wand(recording: WandRecording) -> str:
    reasons = sum(recording.left_out, Counter())
    counts = ", ".join(f"{reason}: {n}" for reason, n in reasons.most_common())
    return f"the wand was in no frame ({counts}); do the wand file's diameter and markers match the wand?"


def label_by_timing(
    rig: Rig, wand: Body, messages: Sequence[Detections], synchronous: bool
) -> tuple[WandRecording, str]:
    """Label a recording as that of synchronous or of other cameras, and return the reason.

    Equal stamps may come from a common trigger, or from software that numbers frames of cameras that run freely. Both
    models, without and with clock offsets, are fitted to one half of the instants; the residuals of the other half
    decide.

    Args:
        rig: its cameras.
        wand: its markers.
        messages: the recording.
        synchronous: whether the user declares the cameras synchronous; otherwise the recording decides.

    Raises:
        CalibrationError: cameras are declared synchronous, but no stamps are equal; or see `labels.label`.
    """
    by_clocks = label_recording(rig, wand, messages)
    share = coincident_share(by_clocks.frames)
    if synchronous:
        if share == 0 and not _any_equal(by_clocks):
            raise CalibrationError(
                "the cameras are declared synchronous, but no two cameras have frames with equal stamps; leave out "
                "--synchronised, or give simultaneous frames the same t_ns"
            )
        if by_clocks.frames.readout_s.any():
            return by_clocks, f"synchronous cameras: declared, but {ROLLING}"
        return label_recording(rig, wand, messages, synchronous=True), "synchronous cameras: declared"
    if share < MIN_COINCIDENT:
        return (
            by_clocks,
            f"clock offsets are estimated: only {share:.0%} of a camera's frames share their stamps",
        )
    if by_clocks.frames.readout_s.any():
        return by_clocks, f"clock offsets are estimated, although frames share their stamps: {ROLLING}"
    by_stamps = label_recording(rig, wand, messages, synchronous=True)
    return _prefer(by_stamps, by_clocks, share)


def _any_equal(recording: WandRecording) -> bool:
    """Whether any two cameras have frames with the same stamp."""
    t_s, camera = recording.frames.t_s, recording.frames.camera
    order = np.argsort(t_s, kind="stable")
    return bool(((np.diff(t_s[order]) == 0) & (np.diff(camera[order]) != 0)).any())


def _prefer(by_stamps: WandRecording, by_clocks: WandRecording, share: float) -> tuple[WandRecording, str]:
    """Return the recording whose model fits held-out instants better, and the reason."""
    by_model = [_fit_half(recording) for recording in (by_stamps, by_clocks)]
    cameras, clocks_px = [placed for placed, _, _ in by_model], by_model[1][1]
    # The motion model of the second also makes poses and lenses better: offsets must explain the difference.
    stamps_px = min(without_px for _, _, without_px in by_model)
    equal = f"at least {share:.0%} of each camera's frames share their stamps with another camera"
    if cameras[0] != cameras[1]:
        held_out = f"{cameras[0]} cameras can be placed without clock offsets, {cameras[1]} with"
        prefer_stamps = cameras[0] > cameras[1]
    else:
        figures = f"{stamps_px:.2f} px without clock offsets, {clocks_px:.2f} px with"
        held_out = f"median residual of held-out instants {figures}"
        prefer_stamps = not stamps_px > MIN_GAIN * clocks_px
    if prefer_stamps:
        return by_stamps, f"synchronous cameras: {equal}; {held_out}"
    return by_clocks, f"clock offsets are estimated, although {equal}: {held_out}"


def _fit_half(recording: WandRecording) -> tuple[int, float, float]:
    """Fit every other run of instants; return the number of cameras placed, and the median residuals of the others,
    pixels, with and without the clocks that were found; infinite where nothing can be fitted."""
    instant = recording.timing.instants(recording.detections.t_s)
    fitted = (instant // RUN) % 2 == 0
    half = recording.select(fitted)
    start = build_initial_rig(
        TwoViewGeometry(half.detections, half.lenses, half.wand, half.timing), range(len(half.names))
    )
    if len(start.placed) < 2:
        return 0, np.inf, np.inf
    try:
        state = adjust_coarsely(half.of_cameras(start.placed), RoughRig.of(start), BUDGET).adjusted.state
    except CalibrationError:
        return 0, np.inf, np.inf
    rest = recording.select(~fitted).of_cameras(start.placed)
    without = replace(state, clocks=np.zeros_like(state.clocks))
    return len(start.placed), _median_residual(rest, state), _median_residual(rest, without)


def _median_residual(recording: WandRecording, state: State) -> float:
    norms = np.linalg.norm(triangulated_residuals(recording, state).pixels, axis=1)
    norms = norms[np.isfinite(norms)]
    return float(np.median(norms)) if len(norms) else np.inf


def _solve_without_exchanged(
    recording: WandRecording, distance: Distance | None
) -> tuple[Placement, Solution]:
    """Solve, leave out detections that are under the wrong camera, and solve again, until there are few or none.

    Raises:
        CalibrationError: as in `_solve_majority`.
    """
    shares: Counter[tuple[str, str]] = Counter()
    placement, solution = _solve_majority(recording, distance)
    for _ in range(MAX_EXCHANGE_PASSES):
        if solution.adjusted.used.mean() > 1 - MIN_REJECTED and not recording.timing.synchronous:
            break
        pairs, right = find_exchanges(placement.recording, solution.adjusted, solution.observations)
        if not pairs:
            break
        shares.update({(pair.shown, pair.of): pair.share for pair in pairs})
        placed = [recording.names.index(name) for name in placement.recording.names]
        mine = np.flatnonzero(np.isin(recording.detections.camera, placed))
        recording = recording.select(mine[right])
        placement, solution = _solve_majority(recording, distance)
    exchanges = tuple(Exchange(*names, share) for names, share in shares.most_common())
    return replace(placement, exchanges=exchanges), solution


def _solve_majority(recording: WandRecording, distance: Distance | None) -> tuple[Placement, Solution]:
    """Solve for the cameras that agree; exclude those that contradict them, until a majority is consistent.

    Raises:
        CalibrationError: fewer than two cameras can be placed, or at most half of them agree.
    """
    pairs = TwoViewGeometry(recording.detections, recording.lenses, recording.wand, recording.timing)
    excluded: dict[str, str] = {}  # the reason, by name of the camera
    certain: dict[str, str] = {}  # of those that are known to be the cause
    while True:
        included = [k for k, name in enumerate(recording.names) if name not in excluded]
        start = build_initial_rig(pairs, included)
        placement = _place(recording, pairs, start, excluded, certain, distance)
        known = placement.scaled_by
        between = known and known.between(placement.recording.names, placement.unplaced)
        try:
            return placement, adjust_rig(placement.recording, RoughRig.of(start, between))
        except CameraFault as fault:
            excluded |= fault.reasons
            certain |= fault.reasons if fault.certain else {}
            if len(start.placed) - len(fault.reasons) <= len(excluded):
                raise CalibrationError(explain_disagreement(recording.names, pairs, excluded)) from None


def _place(
    recording: WandRecording,
    pairs: TwoViewGeometry,
    start: InitialRig,
    excluded: dict[str, str],
    certain: dict[str, str],
    distance: Distance | None,
) -> Placement:
    """Collect what the initial rig places, and the reasons why it does not place the other cameras.

    Raises:
        CalibrationError: it places fewer than two.
    """
    names = recording.names
    counts, shared = count_frames(recording.detections, len(names)), pairs.count_shared()
    faults = find_faults(names, recording.frames, pairs, start.placed)
    unplaced = explain_unplaced(names, counts, shared, start) | excluded | faults | certain
    if len(start.placed) < 2:
        raise CalibrationError(explain_failure(names, counts, shared, excluded | faults))
    by_distance = len(recording.wand.markers) == 1
    return Placement(
        recording.of_cameras(start.placed),
        unplaced=unplaced,
        metric=start.metric,
        scaled_by=distance if by_distance else None,
        compared_with=None if by_distance else distance,
    )


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

    @classmethod
    def of(cls, start: InitialRig, distance: tuple[int, int, float] | None = None) -> "RoughRig":
        """The placed cameras of an initial rig, ascending; scaled to the measured distance, or to 1 m between the
        farthest cameras if there is no scale."""
        cameras, offset_s = (
            np.array([column[k] for k in start.placed]) for column in (start.poses, start.offset_s)
        )
        if distance is not None or not start.metric:
            a, b, wanted = distance or (*_farthest(cameras)[:2], 1.0)
            cameras[:, :3, 3] *= wanted / np.linalg.norm(cameras[a, :3, 3] - cameras[b, :3, 3])
        return cls(cameras, offset_s, start.metric, distance)


def _farthest(cameras: Array) -> tuple[int, int, float]:
    """The two cameras farthest apart, and their distance."""
    gaps = np.linalg.norm(cameras[:, None, :3, 3] - cameras[None, :, :3, 3], axis=2)
    a, b = np.unravel_index(int(gaps.argmax()), gaps.shape)
    return int(a), int(b), float(gaps[a, b])


def adjust_rig(recording: WandRecording, rough: RoughRig) -> Solution:
    """Adjust a rough rig by a recording of the wand.

    Raises:
        CalibrationError: the wand's lengths do not fit the observations or the roundels' sizes.
        CameraFault: a camera's lens differs from its file, or its observations contradict those of the others.
    """
    solution = adjust_coarsely(recording, rough)
    coarse = solution.adjusted
    check_shape(coarse)
    check_lenses(recording.names, coarse)
    check_mirrored(recording.wand, coarse)
    try:
        if not coarse.converged:
            _check_agreement_and_sizes(recording, rough, solution)
            check_residuals(recording, coarse)
        clocks = choose_clocks(coarse, recording.timing)
        fine = _prepare_fine(recording, rough, coarse, clocks)
        solution = _adjust_finely(fine, coarse.inflation)
        _check_agreement_and_sizes(recording, rough, solution)
        return _validate(recording, solution)
    except CameraFault as fault:
        jump = find_jump(recording.names, solution.adjusted, solution.observations)
        if jump is None or jump.camera not in fault.reasons:
            raise
        raise CameraFault({jump.camera: jump.sentence()}, fault.certain) from None


def adjust_coarsely(recording: WandRecording, rough: RoughRig, budget: int = COARSE_SETS) -> Solution:
    """Adjust poses, clocks and lenses on about `budget` frame sets, after a robust optimization of poses and clocks."""
    start = _build(recording, rough, budget)
    problem = start.problem.with_free(POSE, *clock_candidates(recording.timing))
    state = optimize_robustly(problem, start.observations, start.state)
    # Noise in the rough positions looks like acceleration: the first density makes the motion prior too weak, so the
    # motion absorbs noise and the residuals are too small.
    density = acceleration_density(problem.knot_s, state.motion[:, 0], recording.timing.gap_s)
    problem = replace(problem.with_free(problem.free, LENS), density=density)
    observations = with_disc_centres(problem, state, start.observations, recording.wand)
    adjusted = with_readout_times(adjust(problem, observations, state), observations, recording.timing)
    return Solution(adjusted, observations)


def _build(recording: WandRecording, rough: RoughRig, budget: int) -> Estimate:
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


def _prepare_fine(
    recording: WandRecording, rough: RoughRig, coarse: Adjusted, clocks: ClockModel
) -> Estimate:
    """The problem of the fine stage, from the coarse stage's cameras, lenses and clocks."""
    lenses = coarse.state.corrected(recording.lenses)
    better = replace(rough, cameras=coarse.state.cameras, offset_s=clocks.clocks[:, 0])
    start = _build(recording.undistort_tracks(lenses), better, FINE_SETS)
    state = replace(start.state, clocks=clocks.clocks, lenses=coarse.state.lenses, shape=coarse.state.shape)
    density = acceleration_density(coarse.problem.knot_s, coarse.state.motion[:, 0], recording.timing.gap_s)
    problem = start.problem.with_free(POSE, LENS, *clocks.free)
    problem = replace(problem, density=density, drift_sigma=clocks.drift_sigma)
    observations = with_disc_centres(problem, state, start.observations, recording.wand)
    return add_background(recording, Estimate(problem, state, observations))


def _adjust_finely(fine: Estimate, inflation: float) -> Solution:
    """Adjust once with usual lens priors, estimate the lens priors from that, and adjust with these."""
    first = adjust(fine.problem, fine.observations, fine.state, rounds=1)
    problem = estimate_lens_priors(fine.problem, replace(first, inflation=inflation))
    return Solution(adjust(problem, fine.observations, first.state), fine.observations)


def _check_agreement_and_sizes(recording: WandRecording, rough: RoughRig, solution: Solution) -> None:
    """Check that the cameras agree, and the wand's lengths with the roundels' sizes.

    Raises:
        CalibrationError: the wand's lengths do not fit the roundels' sizes.
        CameraFault: as in `check_agreement`.
    """
    check_agreement(recording.names, solution.adjusted, solution.observations)
    if rough.metric:
        check_sizes(recording.wand, solution.adjusted, solution.observations)


def check_agreement(names: Sequence[str], adjusted: Adjusted, observations: WandObservations) -> None:
    """Raise CameraFault where most detections of a camera contradict those of the other cameras.

    Only the worst camera is named, because a wrong camera makes others look wrong. The d parameters of a camera's pose
    and clock fit d coordinates of any detections, so these do not count. A camera of which none is rejected contradicts
    nothing, however few it has.
    """
    total = np.bincount(observations.camera, minlength=len(names))
    fitting = np.bincount(observations.camera[adjusted.used], minlength=len(names))
    share = (fitting - len(set(adjusted.problem.free) - set(LENS)) / 2) / total
    share[fitting == total] = 1.0
    if share.min() < MIN_AGREEING:
        k = int(share.argmin())
        reason = (
            f"only {fitting[k]} of its {total[k]} detections fit those of the other cameras: if it has few, wave the "
            "wand in front of it; else check that its name and its intrinsics are its own and that it did not move; "
            f"run roundel calibrate intrinsics --camera {names[k]}, or leave it out"
        )
        raise CameraFault({names[k]: reason}, certain=False)


def _validate(recording: WandRecording, solution: Solution) -> Solution:
    """Measure the residuals of all detections, and of detections that are held out.

    Of recordings with very many detections, those in the frame sets of the adjustment are measured.

    Raises:
        CameraFault, CalibrationError: as in `check_residuals`.
    """
    adjusted, observations = solution.adjusted, solution.observations
    measured = np.ones(len(recording.detections), bool)
    if len(measured) > MAX_MEASURED:
        measured = np.isin(np.arange(len(measured)), observations.row)
    corrected = recording.with_centres(observations.row, observations.uv).select(measured)
    given = check_residuals(corrected, adjusted)
    residuals = np.full(len(measured), np.nan)
    residuals[measured] = np.linalg.norm(given.pixels, axis=1)
    run = recording.timing.instants(corrected.detections.t_s) // RUN
    last = np.zeros(len(measured), bool)
    last[measured] = run % PARTS == PARTS - 1
    held_out = corrected.select(last[measured])
    part = Estimate(adjusted.problem, adjusted.state, observations).select(~last[observations.row])
    without = optimize(part.problem, part.observations, part.state) if part and last.any() else None
    return replace(
        solution,
        given=given.summary(),
        held_out=triangulated_residuals(held_out, without).summary() if without is not None else None,
        rejected_px=residuals[observations.row[~adjusted.used]],
    )
