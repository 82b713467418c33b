# SPDX-License-Identifier: BSD-3-Clause
"""A labelled recording as a least squares problem: which moments, where the wand was at them, what was observed."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from calib.wand.bundle_adjustment.frame_sets import choose_instants, group_instants
from calib.wand.bundle_adjustment.lens_prior import usual_sigma
from calib.wand.bundle_adjustment.problem import Problem, State, WandObservations
from calib.wand.detections import WandDetections
from calib.wand.initialization.initial_rig import triangulate
from calib.wand.tracks import MarkerTrack
from calib.wand.trajectory import AffineWand, acceleration_density, finite_velocities
from camera_node.arrays import Array, Index, Mask
from camera_node.geometry.body import Body
from camera_node.geometry.lens import Lens

MIN_SIGMA_PX = 0.02  # no lens model is better than this, whatever a detector claims
LENGTH_SLACK = 0.25  # of a wand length at the start: beyond, a detection is wrong
SPIKE = 5.0  # of the usual distance from between the neighbours
MIN_KNOTS = 2


@dataclass(frozen=True, slots=True)
class Wave:
    """Sightings of the C cameras that stand somewhere, numbered 0 to C - 1, and what is known of the recording."""

    seen: WandDetections
    names: Sequence[str]
    lenses: Sequence[Lens]
    tracks: Sequence[Sequence[MarkerTrack]]
    wand: Body
    period_s: float
    gap_s: float
    middle_s: float

    def seen_through(self, lenses: Sequence[Lens]) -> "Wave":
        """The same, its tracks as other lenses saw them; the lenses that were given stay."""
        tracks = [
            [
                MarkerTrack.of(
                    track.t_s, new.normalise(old.project(np.column_stack([track.at, np.ones(len(track.at))])))
                )
                for track in mine
            ]
            for mine, old, new in zip(self.tracks, self.lenses, lenses, strict=True)
        ]
        return replace(self, tracks=tracks)

    def pose_problem(
        self, cameras: Array, offset_s: Array, budget: int
    ) -> tuple[Problem, State, WandObservations] | None:
        """The problem around a rig that is nearly right, with about `budget` moments; None where no two good views
        of the wand are at one of them.

        Args:
            cameras: (C, 4, 4) T_world_cam.
            offset_s: (C,) true time = stamp + offset.
        """
        true_s = self.seen.t_s + offset_s[self.seen.camera]
        order = np.argsort(true_s, kind="stable")
        instant = self._instants(true_s, order)
        rows = order[instant[order] >= 0]
        sizes = np.array([(lens.width, lens.height) for lens in self.lenses], float)
        chosen = choose_instants(self.seen.select(rows), instant[rows], sizes, budget)
        rows = rows[chosen[instant[rows]]]
        knot = np.unique(instant[rows], return_inverse=True)[1]
        knot_s = middles(true_s[rows], knot)
        affine = AffineWand.of(self.wand)
        markers, agreeing = triangulate(self.tracks, cameras, offset_s, knot_s, self.gap_s)
        sure = np.asarray((np.isnan(markers[:, :, 0]) | (agreeing >= 3)).all(axis=1))
        basis = without_spikes(knot_s, find_basis(markers, affine), sure, self.gap_s)
        basis = bridge(knot_s, basis, self.gap_s)
        good = np.asarray(np.isfinite(basis).all(axis=(1, 2)))
        if good.sum() < MIN_KNOTS:
            return None
        renumbered = np.cumsum(good) - 1
        rows, knot = rows[good[knot]], renumbered[knot[good[knot]]]
        knot_s, basis = knot_s[good], basis[good]
        density = acceleration_density(knot_s, basis, self.gap_s)
        lens_sigma = np.array([usual_sigma(lens) for lens in self.lenses])
        problem = Problem(list(self.lenses), affine, knot_s, self.gap_s, density, self.middle_s, lens_sigma)
        motion = np.stack([basis, finite_velocities(knot_s, basis, self.gap_s)], axis=1)
        return problem, State.of(cameras, offset_s, motion), self._observe(rows, knot)

    def _instants(self, true_s: Array, order: Index) -> Index:
        """The moment of every sighting, -1 where only one camera has it."""
        frames, first, back = np.unique(self.seen.frame[order], return_index=True, return_inverse=True)
        t_s, camera = true_s[order][first], self.seen.camera[order][first]
        by_time = np.argsort(t_s, kind="stable")
        of_frame = np.empty(len(frames), np.intp)
        of_frame[by_time] = group_instants(t_s[by_time], camera[by_time], self.period_s)
        instant = np.empty(len(order), np.intp)
        instant[order] = of_frame[back]
        return instant

    def _observe(self, rows: Index, knot: Index) -> WandObservations:
        seen = self.seen.select(rows)
        cov = seen.cov + MIN_SIGMA_PX**2 * np.eye(2)
        columns = (seen.t_s, seen.stamp_sigma_s, seen.uv, cov, seen.axes_px, seen.angle_rad)
        return WandObservations(seen.camera, knot, seen.label, *columns)


def middles(t_s: Array, knot: Index) -> Array:
    """(K,) the middle between the first and the last time of each knot: two knots are never close together."""
    low, high = np.full(knot.max() + 1, np.inf), np.full(knot.max() + 1, -np.inf)
    np.minimum.at(low, knot, t_s)
    np.maximum.at(high, knot, t_s)
    return (low + high) / 2


def find_basis(markers: Array, affine: AffineWand) -> Array:
    """Basis markers (K, B, 3) from triangulated ones (K, M, 3); NaN where lengths are wrong or too few are known."""
    basis = np.full((len(markers), len(affine.basis), 3), np.nan)
    known = np.isfinite(markers).all(axis=2)
    for pattern in np.unique(known, axis=0):
        if np.linalg.matrix_rank(affine.weights[pattern], tol=1e-6) == len(affine.basis):
            rows = (known == pattern).all(axis=1)
            basis[rows] = np.linalg.pinv(affine.weights[pattern]) @ markers[rows][:, pattern]
    ends = basis[:, affine.pairs]
    lengths = np.linalg.norm(ends[:, :, 0] - ends[:, :, 1], axis=2)
    basis[(np.abs(lengths - affine.lengths) > LENGTH_SLACK * affine.lengths).any(axis=1)] = np.nan
    return basis


def without_spikes(knot_s: Array, basis: Array, sure: Mask, gap_s: float) -> Array:
    """The basis without knots that are much farther from between their neighbours than is usual, and than these are,
    unless they are `sure` (K,)."""
    if len(knot_s) < 3:
        return basis
    share = ((knot_s[1:-1] - knot_s[:-2]) / (knot_s[2:] - knot_s[:-2]))[:, None, None]
    off = np.linalg.norm(basis[1:-1] - (1 - share) * basis[:-2] - share * basis[2:], axis=2).max(axis=1)
    off = np.where(np.diff(knot_s)[1:] + np.diff(knot_s)[:-1] <= 2 * gap_s, np.nan_to_num(off), 0.0)
    usual = np.median(off[off > 0]) if (off > 0).any() else np.inf
    beside = np.maximum(np.append(off[1:], 0.0), np.append(0.0, off[:-1]))
    spikes = 1 + np.flatnonzero((off > SPIKE * usual) & (off >= beside))
    basis = basis.copy()
    basis[spikes[~sure[spikes]]] = np.nan
    return basis


def bridge(knot_s: Array, basis: Array, gap_s: float) -> Array:
    """The basis with knots that lack it filled in between neighbours less than `gap_s` apart, along straight lines."""
    known = np.flatnonzero(np.isfinite(basis).all(axis=(1, 2)))
    if len(known) < 2:
        return basis
    after = np.clip(np.searchsorted(knot_s[known], knot_s), 1, len(known) - 1)
    a, b = known[after - 1], known[after]
    share = ((knot_s - knot_s[a]) / (knot_s[b] - knot_s[a]))[:, None, None]
    near = (knot_s[b] - knot_s[a] <= gap_s)[:, None, None] & (share >= 0) & (share <= 1)
    between = np.where(near, (1 - share) * basis[a] + share * basis[b], np.nan)
    return np.where(np.isfinite(basis), basis, between)
