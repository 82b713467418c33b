# SPDX-License-Identifier: BSD-3-Clause
"""Builds an initial rig: two-view geometry of pairs of cameras, chained along a maximum spanning tree.

The essential matrix (Nister 2004) gives the relative pose of two cameras up to scale; the wand's lengths, or the
roundels' sizes, give the scale. The clock shift of two cameras whose relative pose is unknown: at the right shift,
simultaneous detections of both satisfy one epipolar constraint; at a wrong shift the wand has moved. The eight-point
algorithm (Hartley 1997) fits a fundamental matrix robustly to each trial shift. Cameras that share no markers with the
others are placed by the pose of the wand (`body_poses`).

Why a camera could not be placed (a wrong clock, a mirrored image, or too few common detections) is tested by undoing
each fault: if a camera fits another one after its timestamps are shifted, or its image is mirrored, it has that fault.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations, permutations

import cv2
import numpy as np

from calib.errors import CameraFault
from calib.rig.camera import transform
from calib.rig.coverage import spread_evenly
from calib.wand.body_poses import BodyPlacement, has_poses
from calib.wand.detections import (
    SAME_S,
    FrameTable,
    MarkerTrack,
    Timing,
    WandDetections,
    build_tracks,
    group_rows,
    interpolate,
    ranges,
)
from camera_node.foundation.arrays import Array, Index, Mask
from camera_node.geometry.body import Body
from camera_node.geometry.lens import Lens
from camera_node.geometry.pose import invert, motion_from

MIN_FRAME_SETS = 8  # that two cameras must share
FEW = 4  # markers of a wand, up to which all orders of their numbers are tried: 23
MANY = 32  # markers of a wand, above which not all of its lengths are compared
SAMPLE = 1500  # detections that the essential matrix is fitted to
GATE_PX = 5.0
MAX_SPREAD = 0.15  # of the logarithm of the scale, over the wand's lengths: a larger one rejects the pose
MIN_INLIER_RATIO = 0.5  # of the correspondences: fewer inliers reject a pose
MAX_SHIFT_S = 0.32  # largest trial shift: twice the difference of clocks that the server synchronizes
SHIFT_STEP_S = 0.01
SHIFT_SAMPLE = 500  # detections that are used
REWEIGHTINGS = 5  # of reweighting
# A shift is accepted if it raises the logarithm of the likelihood by this much: the best of many trials is better than
# no shift by chance, and the parameters of the fundamental matrix are fitted to each trial.
EVIDENCE = 12.0
FITTED = 8
MIN_COMMON = 16  # correspondences of a trial
MIN_TIMES = 15  # timestamps with correspondences; the markers of one frame add little information
# Inlier ratio and frames of two cameras once the fault is undone: a short piece of a smooth path fits many geometries.
MIN_FAULT_RATIO, MIN_FAULT_FRAMES = 0.8, 60
UNSYNCHRONIZED_S, UNSYNCHRONIZED_STEP_S = 10.0, 0.04  # of the shifts of an unsynchronized clock
MIN_MISFIT = 1e-6  # of the image plane
APART_S = 2.0  # least gap between recordings; cameras of one recording may start one after the other


@dataclass(frozen=True, slots=True)
class TwoView:
    """Relative pose and clock shift of two cameras.

    Attributes:
        a, b: their indices.
        T_a_b: (4, 4) p_a = T_a_b p_b, metres if `metric`, else its translation has length 1.
        shift_s: time by which b's timestamps are later than a's.
        inliers: number of detections of a that agree.
        inlier_ratio: the part of the correspondences that are inliers.
        metric: whether the scale is known.
        depth: distance from its camera to the marker by detection (row), in the unit of T_a_b.
    """

    a: int
    b: int
    T_a_b: Array
    shift_s: float
    inliers: int
    inlier_ratio: float
    metric: bool
    depth: dict[int, float]


@dataclass(frozen=True, slots=True)
class _Correspondences:
    """Detections `rows` (n,) of camera a, and both cameras' image plane coordinates (n, 2) of the same markers."""

    rows: Index
    xy_a: Array
    xy_b: Array


class TwoViewGeometry:
    """Relative poses of the pairs of cameras of a labeled recording, computed on demand.

    Args:
        detections: labeled, of all cameras.
        lenses: of the C cameras.
        wand: its markers.
        timing: how the cameras' frames are related in time.
    """

    def __init__(
        self, detections: WandDetections, lenses: Sequence[Lens], wand: Body, timing: Timing
    ) -> None:
        self.detections, self.lenses, self.wand = detections, lenses, wand
        self.rows = [np.flatnonzero(detections.camera == k) for k in range(len(lenses))]
        self.tracks: list[list[MarkerTrack]] = build_tracks(detections, len(lenses), len(wand.markers))
        self.timing, self.gap_s = timing, timing.gap_s
        self._known: dict[tuple[int, int], TwoView | None] = {}
        self._ranges = ranges(lenses, detections, wand.diameter_m)

    def with_detections(self, detections: WandDetections) -> "TwoViewGeometry":
        """Return the geometry of the same cameras with other detections."""
        return TwoViewGeometry(detections, self.lenses, self.wand, self.timing)

    def count_shared(self) -> Index:
        """Return (C, C) the number of frame sets that two cameras share: of equal stamps for synchronous cameras, else
        approximately, one frame period long."""
        t_s = self.detections.t_s
        if self.timing.synchronous:
            bins = np.unique(t_s, return_inverse=True)[1]
        else:
            bins = (t_s / max(self.timing.period_s, 0.02)).astype(np.intp)
        held = np.zeros((len(self.lenses), int(bins.max(initial=0)) + 1))
        held[self.detections.camera, bins] = 1
        if self.timing.synchronous:
            return (held @ held.T).astype(np.intp)
        near = np.maximum(held, np.roll(held, 1, axis=1))
        return (near @ near.T / 2).astype(np.intp)

    def relate(self, a: int, b: int) -> TwoView | None:
        """Return the relative pose of two cameras; None if the data do not determine it."""
        if (a, b) not in self._known:
            self._known[a, b] = self._estimate(a, b)
        return self._known[a, b]

    def correspond(self, a: int, b: int) -> tuple[Array, Array]:
        """Return image plane coordinates (n, 2) of the same markers in two cameras, at the clock shift that the data
        show."""
        rows = self._overlapping_rows(a, b)
        matches = self._correspond(rows, b, self._find_shift(b, rows))
        return matches.xy_a, matches.xy_b

    def _estimate(self, a: int, b: int) -> TwoView | None:
        rows = self._overlapping_rows(a, b)
        shift_s = self._find_shift(b, rows)
        matches = self._correspond(rows, b, shift_s)
        if (found := self._fit_pose(a, b, matches)) is None:
            return None
        T_a_b, inlier = found
        inliers = matches.rows[inlier]
        if self._count_frames(inliers) < MIN_FRAME_SETS:
            return None
        points = intersect_rays(T_a_b, matches.xy_a[inlier], matches.xy_b[inlier])
        ratios = self._scale_ratios(points, inliers)
        scale = float(np.median(ratios)) if len(ratios) else 1.0
        if len(ratios) and np.median(np.abs(np.log(ratios / scale))) > MAX_SPREAD:
            return None
        T_a_b[:3, 3] *= scale
        points_b = transform(invert(T_a_b), points * scale)
        depth = _lengths(inliers, points * scale) | self._depths_of_b(inliers, points_b, b, shift_s)
        ratio = len(inliers) / len(matches.rows)
        return TwoView(a, b, T_a_b, shift_s, len(inliers), ratio, len(ratios) > 0, depth)

    def _find_shift(self, b: int, rows: Index) -> float:
        if self.timing.synchronous:
            return 0.0
        return find_shift(self.tracks[b], self.detections.select(rows), self.gap_s)

    def _overlapping_rows(self, a: int, b: int) -> Index:
        """Return rows of camera a at times when b has detections, clock shift apart.

        Whole frames, because the markers of a frame give the scale; at most about SAMPLE rows.
        """
        rows, t_s = self.rows[a], self.detections.t_s
        times = np.unique(t_s[self.rows[b]])
        if not len(times) or not len(rows):
            return rows[:0]
        before = np.clip(np.searchsorted(times, t_s[rows]), 1, max(len(times) - 1, 1)) - 1
        before = np.minimum(before, len(times) - 1)
        after = np.minimum(before + 1, len(times) - 1)
        gap = np.minimum(np.abs(times[before] - t_s[rows]), np.abs(times[after] - t_s[rows]))
        near = rows[gap <= self.gap_s + SAME_S]
        frames = np.unique(self.detections.frame[near])
        count = max(round(SAMPLE * len(frames) / max(len(near), 1)), MIN_FRAME_SETS)
        chosen = frames[spread_evenly(len(frames), count)]
        return near[np.isin(self.detections.frame[near], chosen)]

    def _correspond(self, rows: Index, b: int, shift_s: float) -> _Correspondences:
        """Return correspondences of detections `rows` with camera b, whose timestamps are `shift_s` later."""
        found = self.detections.select(rows)
        other = interpolate(self.tracks[b], found.label, found.t_s + shift_s, self.gap_s)
        good = np.isfinite(other[:, 0])
        return _Correspondences(rows[good], found.xy[good], other[good])

    def _fit_pose(self, a: int, b: int, matches: _Correspondences) -> tuple[Array, Mask] | None:
        """T_a_b with a translation of length 1 by the essential matrix of correspondences (n), and its inliers (n,)."""
        if self._count_frames(matches.rows) < MIN_FRAME_SETS:
            return None
        xy_a, xy_b, K = matches.xy_a, matches.xy_b, np.eye(3)
        gate = GATE_PX / ((self.lenses[a].fx + self.lenses[a].fy) / 2)
        E, mask = cv2.findEssentialMat(xy_a, xy_b, K, cv2.USAC_ACCURATE, 0.9999, gate)[:2]
        if E is None or E.shape != (3, 3):
            return None
        _, R, t, mask = cv2.recoverPose(E, xy_a, xy_b, K, mask=mask)[:4]
        return invert(motion_from(R, t)), mask.ravel() > 0

    def _count_frames(self, rows: Index) -> int:
        return len(np.unique(self.detections.frame[rows]))

    def _scale_ratios(self, points: Array, rows: Index) -> Array:
        """Return the factors (r,) that give the wand its lengths, or else the roundels their ranges."""
        frame, label = self.detections.frame[rows], self.detections.label[rows]
        table = np.full((len(np.unique(frame)), len(self.wand.markers), 3), np.nan)
        table[np.unique(frame, return_inverse=True)[1], label] = points
        ratios = np.concatenate([np.zeros(0), *self._length_ratios(table)])
        if not np.isfinite(ratios).any():
            ratios = self._ranges[rows] / np.linalg.norm(points, axis=1)
        return ratios[np.isfinite(ratios)]

    def _length_ratios(self, table: Array) -> Iterator[Array]:
        """Yield the ratios of the wand's lengths to those of its markers (F, M, 3), between markers that are 1, 2, 4,
        ... numbers apart: of a few markers all lengths, of many a number that grows as M log M."""
        points, most = self.wand.points, len(self.wand.markers)
        for step in range(1, most) if most <= MANY else 2 ** np.arange(most.bit_length() - 1):
            gaps = np.linalg.norm(table[:, step:] - table[:, :-step], axis=2)
            known = np.linalg.norm(points[step:] - points[:-step], axis=1)
            yield (known / np.where(gaps > 0, gaps, np.nan)).ravel()

    def _depths_of_b(self, rows: Index, points: Array, b: int, shift_s: float) -> dict[int, float]:
        """Return distances from camera b to points (n, 3) in its frame, at its detections nearest in time."""
        label, t_s = self.detections.label, self.detections.t_s
        depth: dict[int, float] = {}
        markers = len(self.wand.markers)
        groups = zip(group_rows(label[rows], markers), group_rows(label[self.rows[b]], markers), strict=True)
        for mine, others in groups:
            theirs = self.rows[b][others]
            if len(mine) and len(theirs):
                at = np.searchsorted(t_s[theirs], t_s[rows[mine]] + shift_s)
                depth |= _lengths(theirs[np.minimum(at, len(theirs) - 1)], points[mine])
        return depth


def _lengths(rows: Index, points: Array) -> dict[int, float]:
    """Return the distances of points (n, 3) from the origin, by row (n,)."""
    return dict(zip(rows.tolist(), np.linalg.norm(points, axis=1).tolist(), strict=True))


def sampson(E: Array, xy_a: Array, xy_b: Array) -> Array:
    """Return (n,) Sampson distances of correspondences (n, 2) from the epipolar constraint x_b' E x_a = 0.

    Hartley and Zisserman, section 11.4.3.
    """
    a, b = (np.column_stack([xy, np.ones(len(xy))]) for xy in (xy_a, xy_b))
    line_b, line_a = a @ E.T, b @ E
    slope = np.concatenate([line_b[:, :2], line_a[:, :2]], axis=1)
    return np.abs((b * line_b).sum(axis=1)) / np.linalg.norm(slope, axis=1)


def intersect_rays(T_a_b: Array, xy_a: Array, xy_b: Array) -> Array:
    """Triangulate points (n, 3), camera a's frame, from image plane coordinates (n, 2) in two cameras (linear)."""
    P_a, P_b = np.eye(4)[:3], invert(T_a_b)[:3]
    homogeneous = cv2.triangulatePoints(P_a, P_b, xy_a.T, xy_b.T).T
    return np.asarray(homogeneous[:, :3] / homogeneous[:, 3:], float)


def find_shift(
    tracks: Sequence[MarkerTrack],
    detections: WandDetections,
    gap_s: float,
    reach_s: float = MAX_SHIFT_S,
    step_s: float = SHIFT_STEP_S,
) -> float:
    """Return how much later the timestamps of camera b are than those of a, seconds; 0 if the data show no shift.

    Args:
        tracks: of camera b, by marker.
        detections: of camera a.
        gap_s: the longest gap over which the tracks are interpolated.
        reach_s, step_s: the largest shift that is tried, and the first grid; the second one is ten times as fine.
    """
    if not len(detections):
        return 0.0
    detections = detections.select(spread_evenly(len(detections), SHIFT_SAMPLE))
    label, t_s, xy = detections.label, detections.t_s, detections.xy
    middle = round(reach_s / step_s)
    coarse = step_s * np.arange(-middle, middle + 1)
    there = interpolate(tracks, label, t_s + coarse[:, None], gap_s)
    misfits = epipolar_misfits(xy, there)
    known = np.isfinite(misfits)
    if not known.any():
        return 0.0
    # Few correspondences fit an epipolar geometry by chance: the gain of a shift is weighted by their number.
    common = np.isfinite(there[:, :, 0])
    usual = np.median(misfits[known])
    better = np.log((usual + MIN_MISFIT) / (np.where(known, misfits, usual) + MIN_MISFIT))
    best = int(np.where(known, (common.sum(axis=1) - FITTED) * better, -np.inf).argmax())
    times = len(np.unique(t_s[common[best]]))
    independent = min(int(common[best].sum()), 2 * times) - FITTED
    if times < MIN_TIMES or misfits[middle] <= misfits[best] * np.exp(EVIDENCE / independent):
        return 0.0
    fine = coarse[best] + step_s * np.linspace(-1, 1, 11)
    misfits = epipolar_misfits(xy, interpolate(tracks, label, t_s + fine[:, None], gap_s))
    return float(fine[np.argmin(misfits)])


def epipolar_misfits(xy_a: Array, xy_b: Array) -> Array:
    """Fit a fundamental matrix to each of S trials of n correspondences; return (S,) median Sampson distances.

    Args:
        xy_a: (n, 2) image plane coordinates in camera a.
        xy_b: (S, n, 2) in camera b; NaN without a correspondence. A trial with too few has an infinite misfit.
    """
    known = np.isfinite(xy_b[..., 0])
    misfits, enough = np.full(len(known), np.inf), known.sum(axis=1) >= MIN_COMMON
    if not enough.any():
        return misfits
    b = np.where(known[:, None], np.swapaxes(xy_b, 1, 2), 0.0)
    scale_a, scale_b = np.abs(xy_a).mean() + 1e-9, np.abs(b).mean() + 1e-9
    b, known = b[enough], known[enough]
    ha = np.vstack([xy_a.T / scale_a, np.ones(len(xy_a))])
    hb = np.concatenate([b / scale_b, np.ones((len(b), 1, b.shape[2]))], axis=1)
    products = (hb[:, :, None] * ha).reshape(len(b), 9, -1)  # images along the last axis: three times as fast
    weight, median = known.astype(float), misfits
    for _ in range(REWEIGHTINGS):
        moments = (products * weight[:, None]) @ np.swapaxes(products, 1, 2)
        F = np.linalg.eigh(moments)[1][:, :, 0].reshape(-1, 3, 3)
        off = np.abs(F.reshape(-1, 1, 9) @ products)[:, 0]
        slope_b, slope_a = F[:, :2] @ ha / scale_b, np.swapaxes(F, 1, 2)[:, :2] @ hb / scale_a
        distance = off / np.sqrt((slope_b**2).sum(axis=1) + (slope_a**2).sum(axis=1) + 1e-18)
        median = _masked_median(distance, known)
        weight = known / (1 + (distance / (2 * median[:, None] + 1e-9)) ** 2)
    misfits[enough] = median
    return misfits


def _masked_median(values: Array, known: Mask) -> Array:
    ordered = np.sort(np.where(known, values, np.inf), axis=1)
    middle = (known.sum(axis=1) - 1) // 2
    return ordered[np.arange(len(ordered)), middle]


@dataclass(frozen=True, slots=True)
class InitialRig:
    """Approximate poses and time offsets of the connected cameras.

    Attributes:
        poses: (4, 4) T_world_cam by camera index, in an arbitrary world.
        offset_s: by camera index, true time = timestamp + offset; median 0.
        metric: whether the scale is known.
        rejected: inlier ratio by pair of cameras, of the pairs that share enough frame sets but whose relative pose was
            rejected; 0 where there is none.
        reasons: why the pose of the wand places no further camera, by camera; empty for a wand without poses.
    """

    poses: dict[int, Array]
    offset_s: dict[int, float]
    metric: bool
    rejected: dict[tuple[int, int], float]
    reasons: dict[int, str] = field(default_factory=dict)

    @property
    def placed(self) -> list[int]:
        """Indices of the cameras with poses, ascending."""
        return sorted(self.poses)


def build_initial_rig(pairs: TwoViewGeometry, cameras: Sequence[int]) -> InitialRig:
    """Place the largest connected group of `cameras`: by their common points, then by the pose of the wand, of which
    cameras may see different markers."""
    tree, rejected = _build_spanning_tree(pairs, cameras)
    poses, offsets = _chain_poses(tree)
    metric = bool(tree) and tree[0].metric
    reasons = {}
    if has_poses(pairs.wand) and (metric or not tree) and len(poses) < len(cameras):
        body = BodyPlacement(pairs.tracks, pairs.detections, pairs.lenses, pairs.wand, pairs.gap_s)
        joined, offset_s, reasons = body.extend(cameras, poses, offsets)
        if len(joined) > max(len(poses), 1):
            poses, offsets, metric = joined, offset_s, True
    return InitialRig(poses, offsets, metric, rejected, reasons)


def _build_spanning_tree(
    pairs: TwoViewGeometry, cameras: Sequence[int]
) -> tuple[list[TwoView], dict[tuple[int, int], float]]:
    """Return the maximum spanning tree (Kruskal) of the largest group of connected cameras, and the rejected pairs.

    The weight of a pair is the number of shared frame sets. A pair is estimated only if it would join two groups.
    """
    shared, group, chosen = pairs.count_shared(), {c: frozenset([c]) for c in cameras}, []
    rejected: dict[tuple[int, int], float] = {}
    ends = [(a, b) for a in cameras for b in cameras if a < b and shared[a, b] >= MIN_FRAME_SETS // 2]
    for a, b in sorted(ends, key=lambda ab: (-shared[ab], ab)):
        if group[a] == group[b]:
            continue
        pair = pairs.relate(a, b)
        if pair is None or pair.inlier_ratio < MIN_INLIER_RATIO:
            rejected[a, b] = pair.inlier_ratio if pair else 0.0
            continue
        chosen.append(pair)
        group |= dict.fromkeys(group[a] | group[b], group[a] | group[b])
    if not chosen:
        return [], rejected
    largest = max(group.values(), key=lambda g: (len(g), sum(p.inliers for p in chosen if p.a in g), -min(g)))
    return [pair for pair in chosen if pair.a in largest], rejected


def _chain_poses(tree: Sequence[TwoView]) -> tuple[dict[int, Array], dict[int, float]]:
    """Return poses in the frame of the first pair's camera a, and offsets with median 0.

    A pair of unknown scale takes the scale of the pairs before it, from the depths of their common detections.
    """
    if not tree:
        return {}, {}
    poses, offsets = {tree[0].a: np.eye(4)}, {tree[0].a: 0.0}
    depth: dict[int, float] = {}
    waiting = list(tree)
    while waiting:
        pair = next(p for p in waiting if (p.a in poses) != (p.b in poses))
        waiting.remove(pair)
        scale = 1.0 if pair.metric else _common_scale(pair, depth)
        T_a_b = pair.T_a_b.copy()
        T_a_b[:3, 3] *= scale
        if pair.a in poses:
            poses[pair.b], offsets[pair.b] = poses[pair.a] @ T_a_b, offsets[pair.a] - pair.shift_s
        else:
            poses[pair.a], offsets[pair.a] = poses[pair.b] @ invert(T_a_b), offsets[pair.b] + pair.shift_s
        depth |= {row: scale * far for row, far in pair.depth.items()}
    median = float(np.median(list(offsets.values())))
    return poses, {camera: offset - median for camera, offset in offsets.items()}


def _common_scale(pair: TwoView, depth: dict[int, float]) -> float:
    ratios = [depth[row] / far for row, far in pair.depth.items() if row in depth]
    return float(np.median(ratios)) if ratios else 1.0


def find_faults(
    names: Sequence[str], frames: FrameTable, pairs: TwoViewGeometry, placed: Sequence[int]
) -> dict[str, str]:
    """Return the fault of each camera that is not placed, and its remedy, by name; only where a fault is found.

    Args:
        names: of the C cameras.
        frames: of the recording.
        pairs: the two-view geometry of the recording.
        placed: indices of the placed cameras: the others are compared with these, or with all if none is placed.
    """
    faults = {}
    for k in sorted(set(range(len(names))) - set(placed)):
        others = [j for j in (placed or range(len(names))) if j != k and len(pairs.rows[j])]
        if others and len(pairs.rows[k]) and (fault := _find_fault(k, others, names, frames, pairs)):
            faults[names[k]] = fault
    return faults


def _find_fault(
    k: int, others: Sequence[int], names: Sequence[str], frames: FrameTable, pairs: TwoViewGeometry
) -> str:
    """Return the fault of camera k and its remedy; empty if none is found."""
    if gap_s := _gap_s(frames, k, others):
        return (
            f"its frames are {abs(gap_s):.0f} s {_direction(gap_s)} than those of all other cameras; set its clock "
            "(chrony or NTP) and record again"
        )
    other = max(others, key=lambda j: _count_overlapping(frames, pairs, k, j))
    if (mirrored := _fits(_mirrored(pairs, k), k, other)) is not None:
        return f"its image is mirrored {_axis(mirrored)} against that of '{names[other]}'; disable the flip, or undo it"
    for order in _orders(pairs):
        if _fits(_renumbered(pairs, k, order), k, other) is not None:
            numbers = ", ".join(f"{a} is {b}" for a, b in enumerate(order) if a != b)
            return (
                f"its markers have other numbers than those of '{names[other]}': its {numbers}; correct them"
            )
    if shift_s := _find_large_shift(pairs, k, other):
        return (
            f"its timestamps are {abs(shift_s):.2f} s {_direction(shift_s)} than those of '{names[other]}'; set its "
            "clock (chrony or NTP) and record again"
        )
    return ""


def _direction(shift_s: float) -> str:
    return "later" if shift_s > 0 else "earlier"


def _gap_s(frames: FrameTable, k: int, others: Sequence[int]) -> float:
    """Return the time by which camera k recorded after all others, negative if before; 0 below APART_S."""
    mine, theirs = frames.t_s[frames.camera == k], frames.t_s[np.isin(frames.camera, others)]
    after, before = float(mine.min() - theirs.max()), float(theirs.min() - mine.max())
    return after if after > APART_S else -before if before > APART_S else 0.0


def _count_overlapping(frames: FrameTable, pairs: TwoViewGeometry, k: int, other: int) -> int:
    """Count the detections of another camera during the recording of camera k."""
    mine, t_s = frames.t_s[frames.camera == k], pairs.detections.t_s[pairs.rows[other]]
    return int(((t_s >= mine.min()) & (t_s <= mine.max())).sum())


def _fits(pairs: TwoViewGeometry, k: int, other: int) -> TwoView | None:
    """Return the relative pose of another camera and camera k, if they fit each other without doubt."""
    found = pairs.relate(other, k)
    if found is None or found.inlier_ratio < MIN_FAULT_RATIO:
        return None
    frames = len(np.unique(pairs.detections.t_s[list(found.depth)]))
    return found if frames >= MIN_FAULT_FRAMES else None


def _axis(mirrored: TwoView) -> str:
    """Return how an image is mirrored that fits another one once it is flipped left to right: the flip that leaves both
    cameras upright (a flip from top to bottom is one from left to right, and half a turn)."""
    upright = np.hypot(*mirrored.T_a_b[:2, 1]) / np.sqrt(2)  # cosine of an eighth of a turn
    if abs(mirrored.T_a_b[1, 1]) < upright:
        return "along a diagonal (u and v are exchanged)"
    return "left to right" if mirrored.T_a_b[1, 1] > 0 else "top to bottom"


def _orders(pairs: TwoViewGeometry) -> list[tuple[int, ...]]:
    """Return the other orders of the numbers of a wand's markers that are tried; of many markers, the reversed one."""
    count = len(pairs.wand.markers)
    same = tuple(range(count))
    return [o for o in (permutations(same) if count <= FEW else [same[::-1]]) if o != same]


def _renumbered(pairs: TwoViewGeometry, k: int, order: Sequence[int]) -> TwoViewGeometry:
    """Return the geometry with the markers of camera k renumbered: number a becomes order[a]."""
    label = pairs.detections.label.copy()
    label[pairs.rows[k]] = np.array(order)[label[pairs.rows[k]]]
    return pairs.with_detections(replace(pairs.detections, label=label))


def _mirrored(pairs: TwoViewGeometry, k: int) -> TwoViewGeometry:
    """Return the geometry with the image of camera k flipped left to right."""
    detections, rows, lens = pairs.detections, pairs.rows[k], pairs.lenses[k]
    uv, xy = detections.uv.copy(), detections.xy.copy()
    uv[rows, 0] = lens.width - 1 - uv[rows, 0]
    xy[rows] = lens.normalise(uv[rows])
    valid = np.flatnonzero(np.isfinite(xy).all(axis=1))
    return pairs.with_detections(replace(detections, uv=uv, xy=xy).select(valid))


def _find_large_shift(pairs: TwoViewGeometry, k: int, other: int) -> float:
    """Return the shift by which camera k's timestamps are late, if it makes k fit the other camera; else 0. One within
    `MAX_SHIFT_S` is no fault: the adjustment finds it."""
    detections = pairs.detections
    seen = detections.select(pairs.rows[other])
    shift_s = find_shift(pairs.tracks[k], seen, pairs.gap_s, UNSYNCHRONIZED_S, UNSYNCHRONIZED_STEP_S)
    t_s = detections.t_s.copy()
    t_s[pairs.rows[k]] -= shift_s
    moved = pairs.with_detections(replace(detections, t_s=t_s))
    return shift_s if abs(shift_s) > MAX_SHIFT_S and _fits(moved, k, other) is not None else 0.0


def explain_unplaced(
    names: Sequence[str], counts: Sequence[int], shared: Index, start: InitialRig
) -> dict[str, str]:
    """Return the reason by name for each camera that the initial rig lacks.

    Args:
        names: of the C cameras.
        counts: their frames with the wand.
        shared: (C, C) frame sets that two cameras share.
        start: the initial rig.
    """
    reasons = {}
    for k in (k for k in range(len(names)) if k not in start.poses):
        ratios = [ratio for pair, ratio in start.rejected.items() if k in pair]
        if not counts[k]:
            reasons[names[k]] = "it never saw the wand; wave the wand in front of it"
        elif k in start.reasons:
            reasons[names[k]] = start.reasons[k]
        elif (ratio := max(ratios, default=0.0)) > 0:
            reasons[names[k]] = (
                f"its detections fit no other camera (at best {ratio:.0%} of the shared ones are inliers); "
                "check its name, its clock and its intrinsics"
            )
        elif shared[k].max(where=np.arange(len(names)) != k, initial=0) >= 2 * MIN_FRAME_SETS:
            j = int(np.argmax(np.where(np.arange(len(names)) != k, shared[k], -1)))
            reasons[names[k]] = (
                f"it shares {shared[k, j]} frame sets with '{names[j]}', and no pose explains them: check its name, "
                "its clock, its intrinsics, and the numbers of its markers"
            )
        else:
            overlap = ", ".join(f"{shared[k, j]} with {name}" for j, name in enumerate(names) if j != k)
            reasons[names[k]] = (
                f"frame sets shared with other cameras: {overlap}; at least {MIN_FRAME_SETS} consistent ones are "
                "needed; wave the wand where its view overlaps theirs"
            )
    return reasons


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


def explain_failure(
    names: Sequence[str],
    counts: Sequence[int],
    shared: Index,
    faults: dict[str, str],
) -> str:
    """Explain why no two cameras could be placed.

    Args:
        names: of the C cameras.
        counts: their frames with the wand.
        shared: (C, C) frame sets that two cameras share.
        faults: what is wrong with a camera itself, by its name.
    """
    if faults:
        reasons = "; ".join(f"camera '{name}': {fault}" for name, fault in faults.items())
        return f"no two cameras could be placed: {reasons}"
    pairs = np.triu(shared, 1)
    a, b = divmod(int(pairs.argmax()), len(pairs))
    frames = ", ".join(f"{name} {n}" for name, n in zip(names, counts, strict=True))
    remedy = "measure the wand and" if pairs.max() >= MIN_FRAME_SETS else "wave it where views overlap, and"
    seen = (
        f"'{names[a]}' and '{names[b]}' saw the wand at once in {pairs.max()} frame sets, others in fewer"
        if pairs.any()
        else "no two saw the wand at once in any frame set"
    )
    return (
        f"no two cameras could be placed: {seen}, and {MIN_FRAME_SETS} that fit one wand are needed (frames with the "
        f"wand: {frames}); "
        f"{remedy} check the diameter and the markers of the wand file, and the intrinsics"
    )
