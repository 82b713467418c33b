# SPDX-License-Identifier: BSD-3-Clause
"""Assigns the detections of a recording to the markers of the wand.

Detections that carry marker numbers keep them, and codes are such numbers. A wand of three or more markers is found by
its spacing (`spacing`), the ends of a wand of two markers are distinguished over time and between cameras. Labels then
propagate to frames in which markers are missing, from the frames before and after.

The ends of two markers that look alike: swapping them in all frames of all cameras changes nothing; swapping them in
one camera does. From frame to frame of a camera the wand turns little: frames are chained into segments with one
unknown sign each. Between cameras, rays to the same end meet and rays to different ends do not: for two segments that
overlap in time, the epipolar residuals of both labelings give a log likelihood ratio (`_epipolar_evidence`). All signs
together are a synchronization over Z2 (Singer 2011): the maximum spanning tree of the evidence, then a greedy flip of
single signs. The camera poses come from an initial rig of the wand's middle, treated as a wand of one marker: the
middle of two image points is nearly the image of the middle and needs no labels. A second pass uses the labeled ends.
"""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import TYPE_CHECKING

import numpy as np
from msgspec.structs import replace as replace_fields
from numpy.typing import NDArray

from calib.rig.estimation import MARGIN
from calib.rig.rig import Rig
from calib.wand.detections import FrameTable, Timing, WandDetections, WandRecording, build_tracks, gather
from calib.wand.initial_rig import InitialRig, TwoViewGeometry, build_initial_rig, sampson
from calib.wand.spacing import MAX_ROUNDELS, explain_spacing, label_by_spacing, require_distinct
from calib.wand.trajectory import finite_velocities, hermite
from camera_node.foundation.arrays import Array, Index
from camera_node.geometry.body import Body
from camera_node.geometry.lens import Lens
from camera_node.geometry.pose import invert, skew
from camera_node.protocol.messages import Detections

if TYPE_CHECKING:
    from scipy.sparse import coo_array

# Gate of propagation: distance from the interpolated position, and its part of the marker's displacement.
GATE_PX, GATE_SHARE = 8.0, 0.15
MAX_FRAMES = 3.5  # frame periods between the two labeled frames that propagation interpolates
MAX_TURN = 0.5  # change of the wand's image vector, relative to the change by a swap: a turn of 53 degrees
CHAIN_S, CHAIN_PERIODS = 0.2, 1.5  # longest gap within a run: the larger of the two
CLEAR = 3.0  # times the usual change between frames: a longer image vector has not reversed
FASTEST = 1.0  # change of the image vector, image plane units per second, where no two frames give it
SIMULTANEOUS_S = 5e-4  # frames closer in time count as simultaneous
COARSE_PX, FINE_PX = 3.0, 1.5  # scale of epipolar residuals with the poses of the middles, and of the ends
SEPARATION_S = 1e4  # added between runs, so that nothing is interpolated across them


def label_recording(
    rig: Rig, wand: Body, messages: Sequence[Detections], synchronous: bool = False
) -> WandRecording:
    """Collect the detections of a recording, of `synchronous` cameras or of others, and label them.

    Raises:
        CalibrationError: see `label`.
    """
    names = sorted({message.camera for message in messages})
    lenses = [rig.cameras[name] for name in names]
    frames, detections = gather(messages, names, lenses, wand.codes)
    timing = Timing(frames.period_s(), synchronous)
    detections, left_out = label(frames, timing, detections, wand, lenses)
    last = np.searchsorted(frames.camera, range(len(names)), side="right") - 1
    return WandRecording(
        names,
        list(lenses),
        wand,
        frames,
        timing,
        detections,
        build_tracks(detections, len(names), len(wand.markers)),
        left_out,
        middle_s=float(frames.t_s.min() + frames.t_s.max()) / 2,
        readout_s=frames.readout_s[last],
    )


def explain_wand(rig: Rig, wand: Body, messages: Sequence[Detections]) -> str:
    """How the wand of a recording differs from its file, as far as single images show it; empty if they do not."""
    names = sorted({message.camera for message in messages})
    lenses = [rig.cameras[name] for name in names]
    return explain_spacing(wand, gather(messages, names, lenses, wand.codes)[1], lenses)


def explain_codes(wand: Body, messages: Sequence[Detections]) -> str:
    """The codes in a recording that may be the wand's, although its file does not state them; empty if there are not
    enough."""
    read: Counter[int] = Counter()
    for message in messages:
        roundels = message.unpack()
        read.update(roundels.id[np.isfinite(roundels.id_probability)].tolist())
    markers = len(wand.markers)
    others = sorted(code for code, _ in read.most_common(markers) if code not in wand.codes)
    if len(others) < markers:
        return ""
    return (
        f"roundels with the codes {', '.join(map(str, others))} were left out, because the wand file does not state "
        "these; if they are the wand's, add the line code: [...] with the code of each marker"
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
        labels = _label_by_number(detections, markers)
        # A code that is blurred in one frame is read in the next.
        if any(wand.codes) and not timing.synchronous:
            labels = propagate_labels(frames, detections, labels, markers)
        return labels, reason
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


@dataclass(frozen=True, slots=True)
class _Sticks:
    """Frames with two detections, sorted by camera and time.

    Attributes:
        rows: (n, 2) the detections, in an order that is constant within a segment.
        camera, t_s: (n,) camera index and timestamp.
        xy: (n, 2, 2) both ends, image plane coordinates.
        run: (n,) ascending; consecutive frames of a camera between which the wand turns little.
        segment: (n,) ascending; parts of runs within which the order is certain.
    """

    rows: Index
    camera: Index
    t_s: Array
    xy: Array
    run: Index
    segment: Index

    @classmethod
    def of(cls, detections: WandDetections, rows: Index, run: Index) -> "_Sticks":
        """Collect the columns of `rows` (n, 2); each run is one segment."""
        first = rows[:, 0]
        return cls(rows, detections.camera[first], detections.t_s[first], detections.xy[rows], run, run)

    def vectors(self) -> NDArray[np.complex128]:
        """Return (n,) the image vectors from the first end to the second, as complex numbers."""
        gap = self.xy[:, 1] - self.xy[:, 0]
        return gap[:, 0] + 1j * gap[:, 1]

    def usual_change(self) -> float:
        """Return the upper limit of the usual change of the image vector, image plane units per second."""
        within = np.flatnonzero(np.diff(self.run) == 0)
        speed = abs(np.diff(self.vectors()))[within] / np.diff(self.t_s)[within]
        return 2 * float(np.median(speed)) if len(speed) else FASTEST

    def interpolate(self, rows: Index, t_s: Array, gap_s: float) -> tuple[Array, Index]:
        """Interpolate the frames `rows` of one camera at timestamps (m,), within runs and gaps of at most `gap_s`.

        Returns:
            ends: (m, 2, 2) both ends; NaN outside of runs.
            segment: (m,) the segment of the nearest frame.
        """
        stamps, xy, run = self.t_s[rows], self.xy[rows], self.run[rows]
        velocity = finite_velocities(stamps + SEPARATION_S * run, xy, gap_s)
        right = np.clip(np.searchsorted(stamps, t_s), 1, len(rows) - 1)
        left = right - 1
        tau, dt = t_s - stamps[left], stamps[right] - stamps[left]
        knots = np.stack([xy[left], velocity[left], xy[right], velocity[right]], axis=1)
        ends = np.einsum("nh,nhex->nex", hermite(tau, dt), knots)
        inside = (run[left] == run[right]) & (dt <= gap_s) & (tau >= 0) & (tau <= dt)
        nearest = np.where(tau > dt / 2, right, left)
        simultaneous = np.abs(stamps[nearest] - t_s) < SIMULTANEOUS_S
        ends = np.where(simultaneous[:, None, None], xy[nearest], ends)
        ends[~(inside | simultaneous)] = np.nan
        return ends, self.segment[rows[nearest]]


@dataclass(frozen=True, slots=True)
class _Evidence:
    """Log likelihood ratios (e,) of equal over opposite signs of the segments `a` and `b` (e,); pairs may repeat."""

    a: Index
    b: Index
    gain: Array


def label_ends(timing: Timing, detections: WandDetections, wand: Body, lenses: Sequence[Lens]) -> Index:
    """Return the end (n,), 0 or 1, of each detection in a frame of two; -1 where the data do not determine it."""
    cameras = range(len(lenses))
    sticks = _chain(detections, timing)
    if not len(sticks.rows):
        return np.full(len(detections), -1, np.intp)
    gap_s, light = timing.gap_s, replace_fields(wand, markers=((0.0, 0.0, 0.0),))
    middles = TwoViewGeometry(_middles(detections, sticks), lenses, light, timing)
    start = build_initial_rig(middles, cameras)
    labels = _label(sticks, _estimate_signs(sticks, gap_s, start, lenses, COARSE_PX), len(detections))
    if not (labels >= 0).any():
        return labels
    labeled = replace(detections, label=labels).select(labels >= 0)
    refined = build_initial_rig(TwoViewGeometry(labeled, lenses, wand, timing), cameras)
    if len(refined.poses) < len(start.poses):
        return labels
    return _label(sticks, _estimate_signs(sticks, gap_s, refined, lenses, FINE_PX), len(detections))


def _chain(detections: WandDetections, timing: Timing) -> _Sticks:
    """Chain the frames of two detections into runs, and split these into segments; each frame of synchronous cameras is
    a segment, because their frames may be any time apart."""
    limit_s = 0.0 if timing.synchronous else max(CHAIN_S, CHAIN_PERIODS * timing.period_s)
    rows = np.flatnonzero((np.bincount(detections.frame) == 2)[detections.frame]).reshape(-1, 2)
    camera, t_s = detections.camera[rows[:, 0]], detections.t_s[rows[:, 0]]
    duplicate = (np.diff(camera, prepend=-1) == 0) & (np.diff(t_s, prepend=0) <= 0)
    rows = rows[~duplicate]
    sign, run = _follow(_Sticks.of(detections, rows, np.arange(len(rows))), limit_s)
    rows = np.where(sign[:, None] > 0, rows, rows[:, ::-1])
    whole = run == np.minimum.accumulate(run[::-1])[::-1]  # without runs inside of another run
    return _split(_Sticks.of(detections, rows[whole], run[whole]))


def _split(sticks: _Sticks) -> _Sticks:
    """Split runs where the image vector is so short that it may have reversed between two frames."""
    length = abs(sticks.vectors())
    shorter = np.minimum(length[1:], length[:-1])
    split = (np.diff(sticks.run) > 0) | (shorter < CLEAR * sticks.usual_change() * np.diff(sticks.t_s))
    return replace(sticks, segment=np.concatenate([[0], np.cumsum(split)])[: len(sticks.run)])


def _follow(sticks: _Sticks, limit_s: float) -> tuple[Array, Index]:
    """Return signs (n,) that align each frame with its predecessor, and its run, numbered by the first frame.

    A frame that fits neither sign stays alone, and the next frame is chained to the one before it: one of the two
    detections may be wrong.
    """
    camera, t_s, vectors = sticks.camera, sticks.t_s, sticks.vectors()
    sign, run = np.ones(len(vectors)), np.arange(len(vectors))
    last = alone = -1
    for k in range(len(vectors)):
        for j in (last, alone):
            near = j >= 0 and camera[j] == camera[k] and t_s[k] - t_s[j] <= limit_s
            if near and (relative := _relative_sign(sign[j] * vectors[j], vectors[k])):
                sign[k], run[k] = relative, run[j]
                break
        fresh = last < 0 or camera[last] != camera[k] or t_s[k] - t_s[last] > limit_s
        last, alone = (k, -1) if run[k] != k or fresh else (last, k)
    return sign, run


def _relative_sign(before: complex, now: complex) -> int:
    """Return 1 if an image vector kept its direction, -1 if it reversed, 0 if neither is clear."""
    same, swapped = abs(now - before), abs(now + before)
    return 1 if same < MAX_TURN * swapped else -1 if swapped < MAX_TURN * same else 0


def _middles(detections: WandDetections, sticks: _Sticks) -> WandDetections:
    """Return the middles of the two detections as detections of one marker of unknown size."""
    first = detections.select(sticks.rows[:, 0])
    unknown = np.full(len(first), np.nan)
    return replace(
        first,
        label=np.zeros(len(first), np.intp),
        uv=detections.uv[sticks.rows].mean(axis=1),
        xy=sticks.xy.mean(axis=1),
        axes_px=np.column_stack([unknown, unknown]),
        angle_rad=unknown,
    )


def _label(sticks: _Sticks, signs: Index, count: int) -> Index:
    """Return labels (count,) of all detections from the sign of each segment; -1 where it is 0."""
    labels, sign = np.full(count, -1, np.intp), signs[sticks.segment]
    known = sign != 0
    labels[sticks.rows[known]] = np.where(sign[known, None] > 0, [0, 1], [1, 0])
    return labels


def _estimate_signs(
    sticks: _Sticks, gap_s: float, start: InitialRig, lenses: Sequence[Lens], sigma_px: float
) -> Index:
    """Return (S,) the sign of each segment, 1 or -1; 0 where the evidence is too small.

    Segments of cameras without a pose keep their order; `diagnosis` explains later why they have none.
    """
    evidence = []
    for a, b in combinations(start.placed, 2):
        sigma = sigma_px / np.mean([lenses[a].fx, lenses[b].fx])
        evidence.append(_epipolar_evidence(sticks, gap_s, start, (a, b), float(sigma)))
    evidence += [
        _turn_evidence(sticks, gap_s, lag) for lag in (1, 2)
    ]  # of three frames, the middle one may be wrong
    signs = _synchronize(int(sticks.segment.max()) + 1, evidence)
    signs[sticks.segment[~np.isin(sticks.camera, start.placed)]] = 1
    return signs


def _turn_evidence(sticks: _Sticks, gap_s: float, lag: int) -> _Evidence:
    """Compare segments of a camera by the change of the image vector between frames `lag` apart (Cauchy density)."""
    vectors = sticks.vectors()
    k = np.arange(len(sticks.rows) - lag)
    k = k[(sticks.segment[k] < sticks.segment[k + lag]) & (sticks.camera[k] == sticks.camera[k + lag])]
    k = k[sticks.t_s[k + lag] - sticks.t_s[k] <= gap_s]
    before, now = vectors[k], vectors[k + lag]
    usual = sticks.usual_change() * (sticks.t_s[k + lag] - sticks.t_s[k])
    same, swapped = (np.log1p((abs(now + sign * before) / usual) ** 2) for sign in (-1, 1))
    return _Evidence(sticks.segment[k], sticks.segment[k + lag], swapped - same)


def _epipolar_evidence(
    sticks: _Sticks, gap_s: float, start: InitialRig, pair: tuple[int, int], sigma: float
) -> _Evidence:
    """Compare segments of two cameras that overlap in time by their epipolar residuals (Cauchy density)."""
    a, b = pair
    mine, theirs = np.flatnonzero(sticks.camera == a), np.flatnonzero(sticks.camera == b)
    if not len(mine) or len(theirs) < 2:
        return _Evidence(mine[:0], mine[:0], np.empty(0))
    t_s = sticks.t_s[mine] + start.offset_s[a] - start.offset_s[b]
    other, segment = sticks.interpolate(theirs, t_s, gap_s)
    T = invert(start.poses[b]) @ start.poses[a]
    E = skew(T[:3, 3]) @ T[:3, :3]
    ends = sticks.xy[mine]
    cost = [[np.log1p((sampson(E, ends[:, i], other[:, j]) / sigma) ** 2) for j in (0, 1)] for i in (0, 1)]
    gain = cost[0][1] + cost[1][0] - cost[0][0] - cost[1][1]
    known = np.isfinite(gain)
    return _Evidence(sticks.segment[mine[known]], segment[known], gain[known])


def _synchronize(count: int, evidence: Sequence[_Evidence]) -> Index:
    """Return the signs (count,) that agree with most evidence; 0 where it is too small."""
    from scipy.sparse import coo_array

    a, b = (np.concatenate([getattr(e, name) for e in evidence]) for name in ("a", "b"))
    gain = np.concatenate([e.gain for e in evidence])
    graph = coo_array((np.tile(gain, 2), (np.append(a, b), np.append(b, a))), (count, count)).tocsr()
    signs = _span(graph.tocoo(), count)
    for _ in range(count):
        agreement = signs * (graph @ signs)
        if agreement[worst := int(agreement.argmin())] >= 0:
            break
        signs[worst] *= -1
    return np.where(signs * (graph @ signs) >= MARGIN / 2, signs, 0).astype(np.intp)


def _span(graph: "coo_array", count: int) -> Array:
    """Return signs (count,) along the maximum spanning trees of the absolute evidence (Kruskal)."""
    group = [[k] for k in range(count)]
    signs = np.ones(count)
    for e in np.argsort(-np.abs(graph.data)).tolist():
        a, b = int(graph.row[e]), int(graph.col[e])
        if group[a] is group[b]:
            continue
        small, large = sorted((group[a], group[b]), key=len)
        if graph.data[e] * signs[a] * signs[b] < 0:
            signs[small] *= -1
        large += small
        for k in small:
            group[k] = large
    return signs
