# SPDX-License-Identifier: BSD-3-Clause
"""Assigns the detections of a recording to the markers of the wand.

Detections that carry marker numbers keep them. A wand of three or more markers is found by its spacing (`spacing`), the
ends of a wand of two markers are distinguished over time and between cameras (`two_markers`). Labels then propagate to
frames in which markers are missing, from the frames before and after.
"""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from calib.rig.rig import Rig
from calib.wand.detections import FrameTable, WandDetections, gather
from calib.wand.labeling.spacing import MAX_ROUNDELS, label_by_spacing, require_distinct
from calib.wand.labeling.two_markers import label_ends
from calib.wand.timing import Timing
from camera_node.foundation.arrays import Array, Index
from camera_node.geometry.body import Body
from camera_node.geometry.lens import Lens
from camera_node.protocol.messages import Detections

# Gate of propagation: distance from the interpolated position, and its part of the marker's displacement.
GATE_PX, GATE_SHARE = 8.0, 0.15
MAX_FRAMES = 3.5  # frame periods between the two labeled frames that propagation interpolates


@dataclass(frozen=True, slots=True)
class WandRecording:
    """A labeled recording.

    Attributes:
        names, lenses: of its cameras, sorted by name.
        frames: all frames.
        timing: how the cameras' frames are related in time.
        detections: the markers of the wand, at most one row per frame and marker.
        left_out: by camera, the number of frames without a marker by reason.
        background: images of background points, if there are any.
    """

    names: list[str]
    lenses: list[Lens]
    frames: FrameTable
    timing: Timing
    detections: WandDetections
    left_out: list[Counter[str]]
    background: WandDetections | None = None


def label_recording(
    rig: Rig, wand: Body, messages: Sequence[Detections], synchronous: bool = False
) -> WandRecording:
    """Collect the detections of a recording, of `synchronous` cameras or of others, and label them.

    Raises:
        CalibrationError: see `label`.
    """
    names = sorted({message.camera for message in messages})
    lenses = [rig.cameras[name] for name in names]
    frames, detections = gather(messages, names, lenses)
    timing = Timing(frames.period_s(), synchronous)
    return WandRecording(
        names, list(lenses), frames, timing, *label(frames, timing, detections, wand, lenses)
    )


def label(
    frames: FrameTable, timing: Timing, detections: WandDetections, wand: Body, lenses: Sequence[Lens]
) -> tuple[WandDetections, list[Counter[str]]]:
    """Label the detections that are markers of the wand.

    Returns:
        labeled: the labeled rows, at most one per frame and marker.
        left_out: by camera, the number of frames without a labeled detection by reason.

    Raises:
        CalibrationError: the wand is symmetric and the detections carry no numbers.
    """
    labels, reason = _assign_labels(frames, timing, detections, wand, lenses)
    left_out = [Counter() for _ in lenses]
    without = np.setdiff1d(np.arange(len(frames.t_s)), detections.frame[labels >= 0])
    for camera, why in zip(frames.camera[without].tolist(), reason[without].tolist(), strict=True):
        left_out[camera][why] += 1
    return replace(detections, label=labels).select(np.flatnonzero(labels >= 0)), left_out


def _assign_labels(
    frames: FrameTable, timing: Timing, detections: WandDetections, wand: Body, lenses: Sequence[Lens]
) -> tuple[Index, NDArray[np.object_]]:
    """Return the label (n,) of each detection, -1 for none, and the reason (F,) that applies to frames without one."""
    markers = len(wand.markers)
    counts = np.bincount(detections.frame, minlength=len(frames.t_s))
    few = counts < min(3, markers)
    reason = np.where(few, "too few roundels in the frame", "no wand among the roundels").astype(object)
    if (detections.label >= 0).any():
        reason[counts > 0] = "no marker of the wand in the frame"
        return _label_by_number(detections, markers), reason
    if markers == 1:
        reason[counts > 1] = "ambiguous"
        return np.where(counts[detections.frame] == 1, 0, -1), reason
    if markers == 2:
        reason[counts == 2] = "the ends of the wand cannot be distinguished"
        reason[counts > 2] = "ambiguous"
        labels = label_ends(timing, detections, wand, lenses)
    else:
        require_distinct(wand)
        reason[counts > MAX_ROUNDELS] = f"more than {MAX_ROUNDELS} roundels in the frame"
        labels, ambiguous = label_by_spacing(detections, wand, lenses)
        reason[ambiguous] = "ambiguous"
    if not timing.synchronous:
        labels = propagate_labels(frames, detections, labels, markers)
    return labels, reason


def _label_by_number(detections: WandDetections, markers: int) -> Index:
    """Return the numbers that detections carry; -1 for numbers of no marker, or twice in a frame."""
    valid = (detections.label >= 0) & (detections.label < markers)
    key = np.where(valid, detections.frame * markers + detections.label, -1)
    _, inverse, count = np.unique(key, return_inverse=True, return_counts=True)
    return np.where(valid & (count[inverse] == 1), detections.label, -1)


def propagate_labels(frames: FrameTable, detections: WandDetections, labels: Index, markers: int) -> Index:
    """Label detections near the position of a marker, interpolated between two labeled frames of its camera.

    A detection takes the label of the nearest marker, and a marker the nearest detection of a frame.
    """
    labels = labels.copy()
    gap_s = MAX_FRAMES * frames.period_s()
    for camera in np.unique(frames.camera):
        mine = detections.camera == camera
        rows = np.flatnonzero(mine & (labels < 0))
        known = [np.flatnonzero(mine & (labels == marker)) for marker in range(markers)]
        distance = np.column_stack([_gated_distances(detections, rows, k, gap_s) for k in known])
        chosen, marker = _match_nearest(detections.frame[rows], distance)
        labels[rows[chosen]] = marker
    return labels


def _gated_distances(detections: WandDetections, rows: Index, known: Index, gap_s: float) -> Array:
    """Return distances (r,), pixels, of detections from a marker interpolated between its labeled rows `known`.

    Infinite outside the gate, in frames that have the marker, and in gaps above `gap_s`.
    """
    if len(known) < 2:
        return np.full(len(rows), np.inf)
    t_s, uv, frame = detections.t_s, detections.uv, detections.frame
    after = np.searchsorted(t_s[known], t_s[rows])
    inside = (after > 0) & (after < len(known)) & ~np.isin(frame[rows], frame[known])
    a, b = known[np.clip(after - 1, 0, None)], known[np.clip(after, None, len(known) - 1)]
    dt = np.maximum(t_s[b] - t_s[a], 1e-9)
    share = ((t_s[rows] - t_s[a]) / dt)[:, None]
    distance = np.linalg.norm(uv[rows] - (1 - share) * uv[a] - share * uv[b], axis=1)
    gate = GATE_PX + GATE_SHARE * np.linalg.norm(uv[b] - uv[a], axis=1)
    return np.where(inside & (dt <= gap_s) & (distance < gate), distance, np.inf)


def _match_nearest(frame: Index, distance: Array) -> tuple[Index, Index]:
    """Match each row to its nearest marker, and each marker to its nearest row of a frame; return rows and markers.

    Args:
        frame: (r,) of each row.
        distance: (r, M), infinite where a row and a marker do not match.
    """
    nearest = distance.argmin(axis=1)
    least = distance[np.arange(len(distance)), nearest]
    order = np.lexsort((least, nearest, frame))
    key = frame[order] * (distance.shape[1] + 1) + nearest[order]
    first = np.diff(key, prepend=-1) != 0
    chosen = order[first & np.isfinite(least[order])]
    return chosen, nearest[chosen]
