# SPDX-License-Identifier: BSD-3-Clause
"""Two-view geometry: how two cameras stand and how far their clocks are apart, from what both saw.

The essential matrix (Nister 2004) gives the motion up to scale; the wand's lengths or the roundels' sizes the scale.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from calib.rig.camera import transform
from calib.wand.detections import WandDetections, ranges
from calib.wand.initialization.clock_shift import EVIDENCE, FITTED, Common, common_sightings, find_shift
from calib.wand.tracks import MarkerTrack, tracks_of
from camera_node.arrays import Array, Index, Mask
from camera_node.geometry.body import Body
from camera_node.geometry.lens import Lens
from camera_node.geometry.pose import invert

MIN_INSTANTS = 8  # that two cameras must share
SAMPLE = 1500  # sightings that the essential matrix is fitted to
GATE_PX = 5.0
INTERPOLATED = 2.5  # frame periods over which a marker's place is interpolated
SLOWEST_S = 0.5  # and never longer
MAX_SPREAD = 0.15  # of the logarithm of lengths and sizes: a geometry that makes them differ by more is none
AGREEING = 0.3  # of the sightings that both have, at the least, are right: one in two of either camera
MIN_SHARE = 0.5  # of the sightings that both have: a geometry that fewer agree to is none


@dataclass(frozen=True, slots=True)
class TwoView:
    """Camera b seen from camera a.

    Attributes:
        a, b: their numbers.
        T_a_b: (4, 4) p_a = T_a_b p_b, metres if `metric`, else its translation has length 1.
        shift_s: by which b's stamps are later than a's.
        inliers: sightings that agree with it; `share` of those that both have.
        depth: distance to the marker by sighting (row), in the unit of T_a_b: ties scales together.
    """

    a: int
    b: int
    T_a_b: Array
    shift_s: float
    inliers: int
    share: float
    metric: bool
    depth: dict[int, float]


@dataclass(frozen=True, slots=True)
class _Motion:
    """T_a_b with a translation of length 1, the sightings `good` (n,) that agree to it, and a quantile of how far all
    are from the epipolar constraint."""

    common: Common
    T: Array
    good: Mask
    misfit: float


class TwoViewGeometry:
    """What each two cameras of a recording have in common."""

    def __init__(self, seen: WandDetections, lenses: Sequence[Lens], wand: Body, period_s: float) -> None:
        self.seen, self.lenses, self.wand = seen, lenses, wand
        self.rows = [np.flatnonzero(seen.camera == k) for k in range(len(lenses))]
        self.tracks: list[list[MarkerTrack]] = tracks_of(seen, len(lenses), len(wand.markers))
        self.gap_s = min(INTERPOLATED * period_s, SLOWEST_S) if period_s else SLOWEST_S
        self.period_s = period_s
        self._related: dict[tuple[int, int], TwoView | None] = {}
        self.range = ranges(lenses, seen, wand.diameter_m)

    def shared(self) -> Index:
        """(C, C) about how many moments, a frame period long, each two cameras share."""
        bins = (self.seen.t_s / max(self.period_s, 0.02)).astype(np.intp)
        held = np.zeros((len(self.lenses), int(bins.max(initial=0)) + 1))
        held[self.seen.camera, bins] = 1
        near = np.maximum(held, np.roll(held, 1, axis=1))
        return (near @ near.T / 2).astype(np.intp)

    def relate(self, a: int, b: int) -> TwoView | None:
        """Where two cameras stand to each other; None where it can't be told."""
        if (a, b) not in self._related:
            self._related[a, b] = self._relate(a, b)
        return self._related[a, b]

    def _relate(self, a: int, b: int) -> TwoView | None:
        seen, rows = self.seen, self.rows[a]
        near = self._near(rows, b)
        shift_s = find_shift(self.tracks[b], seen.label[near], seen.t_s[near], seen.xy[near], self.gap_s)
        together = self._motion(a, b, near, 0.0)
        apart = self._motion(a, b, near, shift_s) if shift_s else together
        if shift_s and not _tells(together, apart, len(np.unique(seen.t_s[near]))):
            shift_s, apart = 0.0, together
        if apart is None:
            return None
        common, T, good = apart.common, apart.T, apart.good
        inliers = common.rows[good]
        if len(np.unique(seen.frame[inliers])) < MIN_INSTANTS:
            return None
        points = intersect_rays(T, common.xy_a[good], common.xy_b[good])
        ratios = self._ratios(points, inliers)
        scale = float(np.median(ratios)) if len(ratios) else 1.0
        if len(ratios) and np.median(np.abs(np.log(ratios / scale))) > MAX_SPREAD:
            return None
        T[:3, 3] *= scale
        depth = self._depths(T, inliers, points * scale, b, shift_s)
        share = len(inliers) / len(common.rows)
        return TwoView(a, b, T, shift_s, len(inliers), share, len(ratios) > 0, depth)

    def _near(self, rows: Index, b: int) -> Index:
        """Rows at whose time, clocks apart, camera b could have seen the wand; of whole frames, as the markers of a
        frame tell the scale, and not more than are worth while."""
        times = np.unique(self.seen.t_s[self.rows[b]])
        if not len(times) or not len(rows):
            return rows[:0]
        after = np.clip(np.searchsorted(times, self.seen.t_s[rows]), 1, max(len(times) - 1, 1)) - 1
        after = np.minimum(after, len(times) - 1)
        other = np.minimum(after + 1, len(times) - 1)
        gap = np.minimum(
            np.abs(times[after] - self.seen.t_s[rows]), np.abs(times[other] - self.seen.t_s[rows])
        )
        near = rows[gap <= self.gap_s]
        frames = np.unique(self.seen.frame[near])
        count = min(len(frames), max(round(SAMPLE * len(frames) / max(len(near), 1)), 1))
        chosen = frames[np.linspace(0, len(frames) - 1, count).round().astype(np.intp)]
        return near[np.isin(self.seen.frame[near], chosen)]

    def _common(self, rows: Index, b: int, shift_s: float) -> Common:
        seen = self.seen
        return common_sightings(
            self.tracks[b], rows, seen.label[rows], seen.t_s[rows], seen.xy[rows], shift_s, self.gap_s
        )

    def _motion(self, a: int, b: int, rows: Index, shift_s: float) -> "_Motion | None":
        """The motion that most of what both saw agrees to, if b's stamps are later by `shift_s`."""
        common = self._common(rows, b, shift_s)
        if len(np.unique(self.seen.frame[common.rows])) < MIN_INSTANTS:
            return None
        gate = GATE_PX / ((self.lenses[a].fx + self.lenses[a].fy) / 2)
        E, mask = cv2.findEssentialMat(common.xy_a, common.xy_b, np.eye(3), cv2.USAC_ACCURATE, 0.9999, gate)[
            :2
        ]
        if E is None or E.shape != (3, 3):
            return None
        _, R, t, mask = cv2.recoverPose(E, common.xy_a, common.xy_b, np.eye(3), mask=mask)[:4]
        T_b_a = np.eye(4)
        T_b_a[:3, :3], T_b_a[:3, 3] = R, t.ravel()
        miss = sampson(np.asarray(E, float), common.xy_a, common.xy_b)
        return _Motion(common, invert(T_b_a), mask.ravel() > 0, float(np.quantile(miss, AGREEING)))

    def _ratios(self, points: Array, rows: Index) -> Array:
        """By what to multiply the points so that the wand has its lengths, or else roundels their size; (r,) votes."""
        frame, label = self.seen.frame[rows], self.seen.label[rows]
        table = np.full((len(np.unique(frame)), len(self.wand.markers), 3), np.nan)
        table[np.unique(frame, return_inverse=True)[1], label] = points
        gaps = np.linalg.norm(table[:, :, None] - table[:, None], axis=3)
        known = np.linalg.norm(self.wand.points[:, None] - self.wand.points[None], axis=2)
        upper = np.triu(np.ones(known.shape, bool), 1)
        ratios = (known / np.where(gaps > 0, gaps, np.nan))[:, upper].ravel()
        if not np.isfinite(ratios).any():
            ratios = self.range[rows] / np.linalg.norm(points, axis=1)
        return ratios[np.isfinite(ratios)]

    def _depths(self, T: Array, rows: Index, points: Array, b: int, shift_s: float) -> dict[int, float]:
        """Distances from camera a at its sightings, and from camera b at its nearest ones."""
        seen = self.seen
        depth = dict(zip(rows.tolist(), np.linalg.norm(points, axis=1).tolist(), strict=True))
        far = np.linalg.norm(transform(invert(T), points), axis=1)
        for marker in range(len(self.wand.markers)):
            mine = np.flatnonzero(seen.label[rows] == marker)
            theirs = self.rows[b][seen.label[self.rows[b]] == marker]
            if len(mine) and len(theirs):
                at = np.searchsorted(seen.t_s[theirs], seen.t_s[rows[mine]] + shift_s)
                depth |= dict(
                    zip(theirs[np.minimum(at, len(theirs) - 1)].tolist(), far[mine].tolist(), strict=True)
                )
        return depth


def _tells(together: _Motion | None, apart: _Motion | None, moments: int) -> bool:
    """Whether the data say that clocks are apart, by as much as `find_shift` asks for."""
    if together is None or apart is None:
        return together is None
    told = min(len(apart.common.rows), 2 * moments) - FITTED
    return together.misfit > apart.misfit * np.exp(EVIDENCE / told)


def sampson(E: Array, xy_a: Array, xy_b: Array) -> Array:
    """(n,) distances of correspondences (n, 2) from the epipolar constraint x_b' E x_a = 0 (Hartley and Zisserman,
    section 11.4.3)."""
    a, b = (np.column_stack([xy, np.ones(len(xy))]) for xy in (xy_a, xy_b))
    line_b, line_a = a @ E.T, b @ E
    slope = np.concatenate([line_b[:, :2], line_a[:, :2]], axis=1)
    return np.abs((b * line_b).sum(axis=1)) / np.linalg.norm(slope, axis=1)


def intersect_rays(T_a_b: Array, xy_a: Array, xy_b: Array) -> Array:
    """Points (n, 3), camera a's frame, seen at (n, 2) image plane coordinates in two cameras (linear triangulation)."""
    P_a, P_b = np.eye(4)[:3], invert(T_a_b)[:3]
    homogeneous = cv2.triangulatePoints(P_a, P_b, xy_a.T, xy_b.T).T
    return np.asarray(homogeneous[:, :3] / homogeneous[:, 3:], float)
