# SPDX-License-Identifier: BSD-3-Clause
"""Two-view geometry: the relative pose and clock shift of two cameras from their common detections.

The essential matrix (Nister 2004) gives the pose up to scale; the wand's lengths, or the roundels' sizes, give the
scale.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from calib.rig.camera import transform
from calib.wand.detections import WandDetections, ranges
from calib.wand.initialization.clock_shift import find_shift, spread_evenly, supports_shift
from calib.wand.timing import Timing
from calib.wand.tracks import SAME_S, MarkerTrack, build_tracks, interpolate
from camera_node.foundation.arrays import Array, Index, Mask
from camera_node.geometry.body import Body
from camera_node.geometry.lens import Lens
from camera_node.geometry.pose import invert

MIN_FRAME_SETS = 8  # that two cameras must share
SAMPLE = 1500  # detections that the essential matrix is fitted to
GATE_PX = 5.0
MAX_SPREAD = 0.15  # of the logarithm of the scale, over the wand's lengths: a larger one rejects the pose
QUANTILE = 0.3  # of Sampson distances, that are compared: 30 % of the correspondences are right at the least
MIN_INLIER_RATIO = 0.5  # of the correspondences: fewer inliers reject a pose


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


@dataclass(frozen=True, slots=True)
class _RelativePose:
    """T_a_b with a translation of length 1, its inliers (n,), and a low quantile of the Sampson distances."""

    matches: _Correspondences
    T_a_b: Array
    inlier: Mask
    misfit: float


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

    def _estimate(self, a: int, b: int) -> TwoView | None:
        pose, shift_s = self._estimate_with_shift(a, b)
        if pose is None:
            return None
        matches, T_a_b = pose.matches, pose.T_a_b.copy()
        inliers = matches.rows[pose.inlier]
        if self._count_frames(inliers) < MIN_FRAME_SETS:
            return None
        points = intersect_rays(T_a_b, matches.xy_a[pose.inlier], matches.xy_b[pose.inlier])
        ratios = self._scale_ratios(points, inliers)
        scale = float(np.median(ratios)) if len(ratios) else 1.0
        if len(ratios) and np.median(np.abs(np.log(ratios / scale))) > MAX_SPREAD:
            return None
        T_a_b[:3, 3] *= scale
        points_b = transform(invert(T_a_b), points * scale)
        depth = _lengths(inliers, points * scale) | self._depths_of_b(inliers, points_b, b, shift_s)
        ratio = len(inliers) / len(matches.rows)
        return TwoView(a, b, T_a_b, shift_s, len(inliers), ratio, len(ratios) > 0, depth)

    def _estimate_with_shift(self, a: int, b: int) -> tuple[_RelativePose | None, float]:
        """Return the relative pose up to scale and the clock shift, 0 unless the data show one."""
        rows = self._overlapping_rows(a, b)
        if self.timing.synchronous:
            return self._fit_pose(a, b, rows, 0.0), 0.0
        selected = self.detections.select(rows)
        shift_s = find_shift(self.tracks[b], selected, self.gap_s)
        unshifted = self._fit_pose(a, b, rows, 0.0)
        shifted = self._fit_pose(a, b, rows, shift_s) if shift_s else None
        if shifted is None:
            return unshifted, 0.0
        counts = len(shifted.matches.rows), len(np.unique(selected.t_s))
        if unshifted is not None and not supports_shift(unshifted.misfit, shifted.misfit, *counts):
            return unshifted, 0.0
        return shifted, shift_s

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
        count = max(round(SAMPLE * len(frames) / max(len(near), 1)), 1)
        chosen = frames[spread_evenly(len(frames), count)]
        return near[np.isin(self.detections.frame[near], chosen)]

    def _correspond(self, rows: Index, b: int, shift_s: float) -> _Correspondences:
        """Return correspondences of detections `rows` with camera b, whose timestamps are `shift_s` later."""
        found = self.detections.select(rows)
        other = interpolate(self.tracks[b], found.label, found.t_s + shift_s, self.gap_s)
        good = np.isfinite(other[:, 0])
        return _Correspondences(rows[good], found.xy[good], other[good])

    def _fit_pose(self, a: int, b: int, rows: Index, shift_s: float) -> _RelativePose | None:
        """Fit the essential matrix to the detections `rows` of camera a at a clock shift."""
        matches = self._correspond(rows, b, shift_s)
        if self._count_frames(matches.rows) < MIN_FRAME_SETS:
            return None
        xy_a, xy_b, K = matches.xy_a, matches.xy_b, np.eye(3)
        gate = GATE_PX / ((self.lenses[a].fx + self.lenses[a].fy) / 2)
        E, mask = cv2.findEssentialMat(xy_a, xy_b, K, cv2.USAC_ACCURATE, 0.9999, gate)[:2]
        if E is None or E.shape != (3, 3):
            return None
        _, R, t, mask = cv2.recoverPose(E, xy_a, xy_b, K, mask=mask)[:4]
        T_b_a = np.eye(4)
        T_b_a[:3, :3], T_b_a[:3, 3] = R, t.ravel()
        distances = sampson(np.asarray(E, float), xy_a, xy_b)
        return _RelativePose(
            matches, invert(T_b_a), mask.ravel() > 0, float(np.quantile(distances, QUANTILE))
        )

    def _count_frames(self, rows: Index) -> int:
        return len(np.unique(self.detections.frame[rows]))

    def _scale_ratios(self, points: Array, rows: Index) -> Array:
        """Return the factors (r,) that give the wand its lengths, or else the roundels their ranges."""
        frame, label = self.detections.frame[rows], self.detections.label[rows]
        table = np.full((len(np.unique(frame)), len(self.wand.markers), 3), np.nan)
        table[np.unique(frame, return_inverse=True)[1], label] = points
        gaps = np.linalg.norm(table[:, :, None] - table[:, None], axis=3)
        known = np.linalg.norm(self.wand.points[:, None] - self.wand.points[None], axis=2)
        upper = np.triu(np.ones(known.shape, bool), 1)
        ratios = (known / np.where(gaps > 0, gaps, np.nan))[:, upper].ravel()
        if not np.isfinite(ratios).any():
            ratios = self._ranges[rows] / np.linalg.norm(points, axis=1)
        return ratios[np.isfinite(ratios)]

    def _depths_of_b(self, rows: Index, points: Array, b: int, shift_s: float) -> dict[int, float]:
        """Return distances from camera b to points (n, 3) in its frame, at its detections nearest in time."""
        label, t_s = self.detections.label, self.detections.t_s
        depth: dict[int, float] = {}
        for marker in range(len(self.wand.markers)):
            mine = np.flatnonzero(label[rows] == marker)
            theirs = self.rows[b][label[self.rows[b]] == marker]
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
