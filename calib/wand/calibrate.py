# SPDX-License-Identifier: BSD-3-Clause
"""The wand calibration: label the detections, build an initial rig, adjust it, and report.

`calibrate` is the pipeline. Its steps are in `labeling`, `initialization`, `adjustment` and `conclusion`.
"""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations

import numpy as np

from calib.errors import CalibrationError, CameraFault
from calib.rig.rig import Rig
from calib.rig.wand_file import check_diameter
from calib.wand.adjustment import RoughRig, Solution, adjust_rig
from calib.wand.background import gather_background
from calib.wand.bundle_adjustment.problem_setup import LabeledRecording
from calib.wand.conclusion import Placement, conclude
from calib.wand.detections import count_frames
from calib.wand.initialization.diagnosis import explain_unplaced, find_faults
from calib.wand.initialization.initial_rig import InitialRig, build_initial_rig
from calib.wand.initialization.two_view import MIN_FRAME_SETS, MIN_INLIER_RATIO, TwoViewGeometry
from calib.wand.labeling.labels import WandRecording
from calib.wand.quality.checks import check_motion
from calib.wand.quality.exchanges import FoundExchanges, find_exchanges
from calib.wand.report import NOT_RECORDED, Exchange
from calib.wand.result import WandCalibration
from calib.wand.scale import Distance
from calib.wand.synchrony import label_by_timing
from camera_node.foundation.arrays import Index
from camera_node.geometry.body import Body
from camera_node.protocol.messages import Detections

MIN_REJECTED = 0.01  # share of rejected observations, from which they are explained
MAX_EXCHANGE_PASSES = 3  # each finds more, because the rig and the motion are better


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
    check_diameter(wand, messages)
    if distance is not None:
        distance.check(list(rig.cameras))
    recording, timing = label_by_timing(rig, wand, messages, synchronous)
    start_ns = min(message.t_ns for message in messages)
    lenses = [rig.cameras[name] for name in recording.names]
    beside = gather_background(background, recording.names, lenses, start_ns)
    recording = replace(recording, background=beside)
    if not len(recording.detections):
        raise CalibrationError(_explain_no_wand(recording))
    check_motion(recording.detections, recording.names, recording.lenses)
    pairs = TwoViewGeometry(recording.detections, recording.lenses, wand, recording.timing)
    placement, solution = _solve_without_exchanged(recording, pairs, distance)
    absent = {name: NOT_RECORDED for name in rig.cameras if name not in recording.names}
    return conclude(rig, solution, replace(placement, unplaced=placement.unplaced | absent, timing=timing))


def check_recording(rig: Rig, messages: Sequence[Detections]) -> None:
    """Raise CalibrationError if a recording does not fit the rig, or has fewer than two cameras."""
    sizes = {message.camera: (message.width, message.height) for message in messages}
    check_cameras(rig, messages, "the recording")
    if len(sizes) < 2:
        only = f"one camera, '{next(iter(sizes))}'" if sizes else "no camera"
        raise CalibrationError(f"the recording has {only}; a wand calibration needs two or more")
    for name, (width, height) in sizes.items():
        lens = rig.cameras[name]
        if (width, height) != (lens.width, lens.height):
            raise CalibrationError(
                f"camera '{name}' delivers {width} x {height} pixels, its intrinsics are for "
                f"{lens.width} x {lens.height}; record at that size or calibrate the lens again"
            )


def check_cameras(rig: Rig, messages: Sequence[Detections], of: str) -> None:
    """Raise CalibrationError if messages come from a camera that is not in the rig."""
    if unknown := sorted({message.camera for message in messages} - set(rig.cameras)):
        raise CalibrationError(
            f"camera '{unknown[0]}' of {of} is not in the rig, which has "
            f"{', '.join(sorted(rig.cameras))}; run roundel calibrate intrinsics --camera {unknown[0]}"
        )


@dataclass(slots=True)
class _Excluded:
    """Cameras that contradict the others, by name with the reason; `certain` ones are known to be the cause."""

    reasons: dict[str, str] = field(default_factory=dict)
    certain: dict[str, str] = field(default_factory=dict)

    def add(self, fault: CameraFault) -> None:
        self.reasons |= fault.reasons
        self.certain |= fault.reasons if fault.certain else {}


def _solve_majority(
    recording: WandRecording, pairs: TwoViewGeometry, distance: Distance | None
) -> tuple[Placement, Solution]:
    """Solve for the cameras that agree; exclude those that contradict them, until a majority is consistent.

    Raises:
        CalibrationError: fewer than two cameras can be placed, or at most half of them agree.
    """
    excluded = _Excluded()
    while True:
        included = [k for k, name in enumerate(recording.names) if name not in excluded.reasons]
        start = build_initial_rig(pairs, included)
        placement = _place(recording, pairs, start, excluded, distance)
        known = placement.scaled_by and placement.scaled_by.between(placement.names, placement.unplaced)
        poses, offset_s = (
            np.array([column[k] for k in start.placed]) for column in (start.poses, start.offset_s)
        )
        labeled = LabeledRecording.of(recording, pairs, start.placed)
        try:
            return placement, adjust_rig(labeled, RoughRig(poses, offset_s, start.metric, known))
        except CameraFault as fault:
            excluded.add(fault)
            if len(start.placed) - len(fault.reasons) <= len(excluded.reasons):
                raise CalibrationError(
                    explain_disagreement(recording.names, pairs, excluded.reasons)
                ) from None


def _solve_without_exchanged(
    recording: WandRecording, pairs: TwoViewGeometry, distance: Distance | None
) -> tuple[Placement, Solution]:
    """Solve, leave out detections that are under the wrong camera, and solve again, until there are few or none.

    Raises:
        CalibrationError: as in `_solve_majority`.
    """
    shares: Counter[tuple[str, str]] = Counter()
    placement, solution = _solve_majority(recording, pairs, distance)
    for _ in range(MAX_EXCHANGE_PASSES):
        placed = [recording.names.index(name) for name in placement.names]
        found = _find_exchanges(recording, pairs, placed, solution)
        if found is None:
            break
        shares.update({(pair.shown, pair.of): pair.share for pair in found.pairs})
        mine = np.flatnonzero(np.isin(recording.detections.camera, placed))
        detections = recording.detections.select(mine[found.tested & ~found.wrong])
        recording, pairs = replace(recording, detections=detections), pairs.with_detections(detections)
        placement, solution = _solve_majority(recording, pairs, distance)
    exchanges = tuple(Exchange(*names, share) for names, share in shares.most_common())
    return replace(placement, exchanges=exchanges), solution


def _find_exchanges(
    recording: WandRecording, pairs: TwoViewGeometry, placed: list[int], solution: Solution
) -> FoundExchanges | None:
    """Find the detections of cameras that are under the wrong one; None if the adjustment used nearly all."""
    if solution.adjusted.used.mean() > 1 - MIN_REJECTED and not recording.timing.synchronous:
        return None
    labeled = LabeledRecording.of(recording, pairs, placed)
    return find_exchanges(labeled, solution.adjusted, solution.observations)


def _place(
    recording: WandRecording,
    pairs: TwoViewGeometry,
    start: InitialRig,
    excluded: _Excluded,
    distance: Distance | None,
) -> Placement:
    """Collect what the initial rig places, and the reasons why it does not place the other cameras.

    Raises:
        CalibrationError: it places fewer than two.
    """
    names, placed = recording.names, start.placed
    counts, shared = count_frames(recording.detections, len(names)), pairs.count_shared()
    faults = find_faults(names, recording.frames, pairs, placed)
    unplaced = explain_unplaced(names, counts, shared, start) | excluded.reasons | faults | excluded.certain
    if len(placed) < 2:
        faults = excluded.reasons | faults
        raise CalibrationError(
            _explain_faults(faults) if faults else _explain_failure(names, counts, shared, unplaced)
        )
    by_distance = len(pairs.wand.markers) == 1
    return Placement(
        names=[names[k] for k in placed],
        frames=[counts[k] for k in placed],
        left_out=[recording.left_out[k] for k in placed],
        unplaced=unplaced,
        metric=start.metric,
        scaled_by=distance if by_distance else None,
        compared_with=None if by_distance else distance,
    )


def explain_disagreement(names: Sequence[str], pairs: TwoViewGeometry, reasons: dict[str, str]) -> str:
    """State which pairs of cameras agree by themselves, and what would reconcile the others."""
    agreeing = []
    for a, b in combinations(range(len(names)), 2):
        pair = pairs.relate(a, b)
        if pair is not None and pair.inlier_ratio >= MIN_INLIER_RATIO:
            agreeing.append(f"'{names[a]}' and '{names[b]}' ({pair.inlier_ratio:.0%} of their detections)")
    which = ", ".join(agreeing) if agreeing else "none"
    return (
        f"half of the cameras or more contradict each other: {CameraFault(reasons)}. Pairs that agree "
        f"by themselves: {which}. Record again with cameras and clocks that nothing moves, or leave cameras out"
    )


def _explain_no_wand(recording: WandRecording) -> str:
    reasons = sum(recording.left_out, Counter())
    counts = ", ".join(f"{reason}: {n}" for reason, n in reasons.most_common())
    return f"the wand was in no frame ({counts}); do the wand file's diameter and markers match the wand?"


def _explain_faults(faults: dict[str, str]) -> str:
    reasons = "; ".join(f"camera '{name}': {fault}" for name, fault in faults.items())
    return f"no two cameras could be placed: {reasons}"


def _explain_failure(names: list[str], counts: list[int], shared: Index, unplaced: dict[str, str]) -> str:
    """Explain why no two cameras could be placed, from the frame sets (C, C) that they share."""
    pairs = np.triu(shared, 1)
    if not pairs.any():
        frames = ", ".join(f"{name} {n}" for name, n in zip(names, counts, strict=True))
        return (
            f"no two cameras ever saw the wand at once (frames with the wand: {frames}); wave the wand where views "
            "overlap"
        )
    if pairs.max() >= MIN_FRAME_SETS:
        a, b = np.unravel_index(int(pairs.argmax()), pairs.shape)
        return (
            f"no two cameras could be placed, although '{names[a]}' and '{names[b]}' saw the wand at once "
            f"{pairs.max()} times: their detections do not fit a wand with these markers; measure the wand, and check "
            "the intrinsics of the cameras"
        )
    reasons = "; ".join(f"camera '{name}': {reason}" for name, reason in unplaced.items())
    return f"no two cameras could be placed; wave the wand where two cameras see it at once ({reasons})"
