# SPDX-License-Identifier: BSD-3-Clause
"""From a waved wand to a rig: label, start from pairs, adjust, choose a world."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from calib.errors import CalibrationError, CameraFault
from calib.rig.rig import Rig
from calib.wand.adjustment import RoughRig, Solution, adjust_rig
from calib.wand.bundle_adjustment.problem_setup import LabeledRecording
from calib.wand.detections import FrameTable, WandDetections, frame_counts, gather
from calib.wand.initialization.diagnosis import find_faults
from calib.wand.initialization.initial_rig import InitialRig, explain_unplaced, find_start
from calib.wand.initialization.two_view import MIN_INSTANTS, TwoViewGeometry
from calib.wand.labeling import label
from calib.wand.outcome import Told, WandCalibration, conclude
from calib.wand.quality.checks import check_motion
from calib.wand.scale import Distance
from camera_node.arrays import Array
from camera_node.geometry.body import Body
from camera_node.geometry.lens import Lens
from camera_node.protocol.messages import Detections


@dataclass(frozen=True, slots=True)
class WandRecording:
    """A labelled recording: cameras in order of names."""

    names: list[str]
    lenses: list[Lens]
    frames: FrameTable
    seen: WandDetections
    left_out: list[Counter[str]]


def calibrate(
    rig: Rig, wand: Body, messages: Sequence[Detections], distance: Distance | None = None
) -> WandCalibration:
    """Place the cameras of a rig, and set their clocks, by a wand waved before them.

    Args:
        rig: intrinsics of every camera; poses in it are not used.
        wand: its markers; two of them or more give the scale, one gives it only by the roundel's size.
        messages: detections of all cameras, any order; a roundel's `id`, where given, is its marker number.
        distance: of two cameras: the scale, where the wand has one marker; else compared with what the wand gives.

    Returns:
        the rig with the poses and time offsets of all cameras that could be placed, and the report.

    Raises:
        CalibrationError: the recording or the wand can't place two cameras, or cameras contradict each other and no
            majority agrees; the message says why.
    """
    check_recording(rig, messages)
    if distance is not None:
        distance.check(list(rig.cameras))
    recording = read(rig, wand, messages)
    if not len(recording.seen):
        raise CalibrationError(_unseen(recording))
    check_motion(recording.seen, recording.names, recording.lenses)
    pairs = TwoViewGeometry(recording.seen, recording.lenses, wand, recording.frames.period_s())
    told, solution = _solve_majority(recording, pairs, wand, distance)
    absent = {name: "is not in the recording" for name in rig.cameras if name not in recording.names}
    return conclude(rig, solution, replace(told, unplaced=told.unplaced | absent))


def _solve_majority(
    recording: WandRecording, pairs: TwoViewGeometry, wand: Body, distance: Distance | None
) -> tuple[Told, Solution]:
    """The solution of the cameras that agree; those that contradict them are left out, and told.

    Raises:
        CalibrationError: fewer than two can be placed, or no more than half of those agree.
    """
    names, counts = recording.names, frame_counts(recording.seen, len(recording.names))
    wrong: dict[str, str] = {}
    sure: dict[str, str] = {}
    while True:
        start = find_start(pairs, [k for k, name in enumerate(names) if name not in wrong])
        placed = sorted(start.poses)
        faults = find_faults(names, recording.frames, pairs, placed)
        unplaced = explain_unplaced(names, placed, counts, pairs.shared(), start) | wrong | faults | sure
        if len(placed) < 2:
            raise CalibrationError(_unplaceable(recording, counts, pairs, unplaced, wrong | faults))
        left_out = [recording.left_out[k] for k in placed]
        told = Told([names[k] for k in placed], [counts[k] for k in placed], left_out, unplaced, start.metric)
        told = replace(told, distance=distance, scaled=distance is not None and len(wand.markers) == 1)
        known = distance.between(told.names, unplaced) if distance is not None and told.scaled else None
        rough = RoughRig(*_columns(start, placed), start.metric, known)
        try:
            return told, adjust_rig(gather_wave(recording, pairs, wand, placed), rough)
        except CameraFault as fault:
            wrong |= fault.reasons
            sure |= fault.reasons if fault.certain else {}
            if len(placed) - len(fault.reasons) <= len(wrong):
                raise CalibrationError(f"no majority of the cameras agrees: {CameraFault(wrong)}") from None


def check_recording(rig: Rig, messages: Sequence[Detections]) -> None:
    """Raise CalibrationError where a recording can't belong to a rig, or has fewer than two cameras."""
    sizes = {message.camera: (message.width, message.height) for message in messages}
    if unknown := sorted(set(sizes) - set(rig.cameras)):
        raise CalibrationError(
            f"camera '{unknown[0]}' of the recording is not in the rig, which has "
            f"{', '.join(sorted(rig.cameras))}; run python -m calib intrinsics --camera {unknown[0]}"
        )
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


def read(rig: Rig, wand: Body, messages: Sequence[Detections]) -> WandRecording:
    """Label a recording's detections."""
    names = sorted({message.camera for message in messages})
    lenses: list[Lens] = [rig.cameras[name] for name in names]
    frames, seen = gather(messages, names, lenses)
    return WandRecording(names, lenses, frames, *label(frames, seen, wand, lenses))


def _unseen(recording: WandRecording) -> str:
    reasons = sum(recording.left_out, Counter())
    told = ", ".join(f"{reason}: {n}" for reason, n in reasons.most_common())
    return f"the wand was in no frame ({told}); do the wand file's diameter and markers match the wand?"


def _unplaceable(
    recording: WandRecording,
    counts: list[int],
    pairs: TwoViewGeometry,
    unplaced: dict[str, str],
    faults: dict[str, str],
) -> str:
    if faults:
        told = "; ".join(f"camera '{name}': {fault}" for name, fault in faults.items())
        return f"no two cameras could be placed: {told}"
    shared = pairs.shared()
    if not (shared - np.diag(np.diag(shared))).any():
        seen = ", ".join(f"{name} {n}" for name, n in zip(recording.names, counts, strict=True))
        return f"no two cameras ever saw the wand at once (frames with the wand: {seen}); wave where views overlap"
    if shared.max(initial=0, where=~np.eye(len(shared), dtype=bool)) >= MIN_INSTANTS:
        most = np.triu(shared, 1)
        a, b = np.unravel_index(int(most.argmax()), most.shape)
        return (
            f"no two cameras could be placed, though '{recording.names[a]}' and '{recording.names[b]}' saw the wand at "
            f"once {most.max()} times: what they saw does not fit a wand with these markers; measure it, and compare "
            "the intrinsics with the cameras"
        )
    told = "; ".join(f"camera '{name}': {reason}" for name, reason in unplaced.items())
    return f"no two cameras could be placed; wave where two see the wand at once ({told})"


def gather_wave(
    recording: WandRecording, pairs: TwoViewGeometry, wand: Body, placed: list[int]
) -> LabeledRecording:
    """What the placed cameras saw, numbered anew."""
    number = np.full(len(recording.names), -1)
    number[placed] = np.arange(len(placed))
    seen = recording.seen.select(number[recording.seen.camera] >= 0)
    seen = replace(seen, camera=number[seen.camera])
    t_s = recording.frames.t_s
    return LabeledRecording(
        seen,
        [recording.names[k] for k in placed],
        [recording.lenses[k] for k in placed],
        [pairs.tracks[k] for k in placed],
        wand,
        pairs.period_s,
        pairs.gap_s,
        float(t_s.min() + t_s.max()) / 2,
    )


def _columns(start: InitialRig, placed: list[int]) -> tuple[Array, Array]:
    return np.array([start.poses[k] for k in placed]), np.array([start.offset_s[k] for k in placed])
