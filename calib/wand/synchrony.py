# SPDX-License-Identifier: BSD-3-Clause
"""Decides whether cameras are synchronous: whether frames with equal stamps show the wand at the same moment.

Equal stamps may come from a common trigger, or from software that numbers frames of cameras that run freely. Both
models, without and with clock offsets, are fitted to one half of the instants; the residuals of the other half decide.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from calib.errors import CalibrationError
from calib.rig.rig import Rig
from calib.wand.adjustment import RoughRig, adjust_coarsely, scale_rig
from calib.wand.bundle_adjustment.problem import State
from calib.wand.bundle_adjustment.problem_setup import LabeledRecording
from calib.wand.initialization.initial_rig import build_initial_rig
from calib.wand.initialization.two_view import TwoViewGeometry
from calib.wand.labeling.labels import WandRecording, label_recording
from calib.wand.quality.held_out import triangulated_residuals
from calib.wand.timing import MIN_COINCIDENT, coincident_share
from camera_node.foundation.arrays import Mask
from camera_node.geometry.body import Body
from camera_node.protocol.messages import Detections

BUDGET = 80  # instants that either model is fitted to
RUN = 8  # consecutive instants that belong to the same half, so that tracks can be interpolated within it
# Interpolation averages the noise of two frames, which by itself lowers residuals by up to 8 %: midway, the weights of
# the cubic polynomial give half of the variance to one of two cameras.
ROLLING = "the rows of rolling shutters are captured one after another, so the wand's motion matters"
MIN_GAIN = 1.1  # ratio of the residuals without and with clock offsets, from which offsets are preferred


def label_by_timing(
    rig: Rig, wand: Body, messages: Sequence[Detections], synchronous: bool
) -> tuple[WandRecording, str]:
    """Label a recording as that of synchronous or of other cameras, and return the reason.

    Args:
        rig: its cameras.
        wand: its markers.
        messages: the recording.
        synchronous: whether the user declares the cameras synchronous; otherwise the recording decides.

    Raises:
        CalibrationError: cameras are declared synchronous, but no stamps are equal; or see `labeling.label`.
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
    return _prefer(by_stamps, by_clocks, wand, share)


def _any_equal(recording: WandRecording) -> bool:
    """Whether any two cameras have frames with the same stamp."""
    t_s, camera = recording.frames.t_s, recording.frames.camera
    order = np.argsort(t_s, kind="stable")
    return bool(((np.diff(t_s[order]) == 0) & (np.diff(camera[order]) != 0)).any())


def _prefer(
    by_stamps: WandRecording, by_clocks: WandRecording, wand: Body, share: float
) -> tuple[WandRecording, str]:
    """Return the recording whose model fits held-out instants better, and the reason."""
    by_model = [_fit_half(recording, wand) for recording in (by_stamps, by_clocks)]
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


def _fit_half(recording: WandRecording, wand: Body) -> tuple[int, float, float]:
    """Fit every other run of instants; return the number of cameras placed, and the median residuals of the others,
    pixels, with and without the clocks that were found; infinite where nothing can be fitted."""
    instant = recording.timing.instants(recording.detections.t_s)
    fitted = (instant // RUN) % 2 == 0
    half, pairs = _select(recording, wand, fitted)
    start = build_initial_rig(pairs, range(len(recording.names)))
    if len(start.placed) < 2:
        return 0, np.inf, np.inf
    try:
        poses = np.array([start.poses[k] for k in start.placed])
        offset_s = np.array([start.offset_s[k] for k in start.placed])
        rough = scale_rig(RoughRig(poses, offset_s, start.metric))
        state = adjust_coarsely(LabeledRecording.of(half, pairs, start.placed), rough, BUDGET).state
    except CalibrationError:
        return 0, np.inf, np.inf
    rest = LabeledRecording.of(*_select(recording, wand, ~fitted), start.placed)
    without = replace(state, clocks=np.zeros_like(state.clocks))
    return len(start.placed), _median_residual(rest, state), _median_residual(rest, without)


def _median_residual(recording: LabeledRecording, state: State) -> float:
    norms = np.linalg.norm(triangulated_residuals(recording, state).pixels, axis=1)
    norms = norms[np.isfinite(norms)]
    return float(np.median(norms)) if len(norms) else np.inf


def _select(recording: WandRecording, wand: Body, rows: Mask) -> tuple[WandRecording, TwoViewGeometry]:
    """Return the rows of a recording, and their two-view geometry."""
    detections = recording.detections.select(rows)
    part = replace(recording, detections=detections)
    return part, TwoViewGeometry(detections, recording.lenses, wand, recording.timing)
