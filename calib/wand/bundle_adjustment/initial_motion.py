# SPDX-License-Identifier: BSD-3-Clause
"""Finds the wand's position at every knot for the start of the adjustment, by triangulation from a rough rig."""

from collections.abc import Sequence

import numpy as np

from calib.wand.tracks import MarkerTrack, triangulate
from calib.wand.trajectory import AffineWand
from camera_node.foundation.arrays import Array, Mask

LENGTH_TOLERANCE = 0.25  # of a wand length: beyond, a detection is wrong
SPIKE = 5.0  # of the median deviation from the neighbours' straight line
MIN_AGREEING = 3  # rays that make a position reliable


def initial_positions(
    tracks: Sequence[Sequence[MarkerTrack]],
    wand: AffineWand,
    cameras: Array,
    offset_s: Array,
    knot_s: Array,
    gap_s: float,
) -> Array:
    """(K, B, 3) positions of the wand's basis markers at the knots, world; NaN where unknown.

    Args:
        tracks: by camera and marker, by stamps.
        wand: in affine coordinates.
        cameras: (C, 4, 4) T_world_cam.
        offset_s: (C,) true time = stamp + offset.
        knot_s: (K,) ascending.
        gap_s: longest time over which positions are interpolated.
    """
    markers, agreeing = triangulate(tracks, cameras, offset_s, knot_s, gap_s)
    reliable = np.asarray((np.isnan(markers[:, :, 0]) | (agreeing >= MIN_AGREEING)).all(axis=1))
    basis = solve_basis(markers, wand)
    basis = remove_spikes(knot_s, basis, reliable, gap_s)
    return interpolate_missing(knot_s, basis, gap_s)


def solve_basis(markers: Array, wand: AffineWand) -> Array:
    """Positions of the basis markers (K, B, 3) from those of all markers (K, M, 3), by least squares; NaN where the
    lengths are wrong or too few markers are known."""
    basis = np.full((len(markers), len(wand.basis), 3), np.nan)
    known = np.isfinite(markers).all(axis=2)
    for pattern in np.unique(known, axis=0):
        if np.linalg.matrix_rank(wand.weights[pattern], tol=1e-6) == len(wand.basis):
            rows = (known == pattern).all(axis=1)
            basis[rows] = np.linalg.pinv(wand.weights[pattern]) @ markers[rows][:, pattern]
    ends = basis[:, wand.pairs]
    lengths = np.linalg.norm(ends[:, :, 0] - ends[:, :, 1], axis=2)
    basis[(np.abs(lengths - wand.lengths) > LENGTH_TOLERANCE * wand.lengths).any(axis=1)] = np.nan
    return basis


def remove_spikes(knot_s: Array, basis: Array, reliable: Mask, gap_s: float) -> Array:
    """The positions (K, B, 3) with NaN at spikes: knots that are not `reliable` (K,) and deviate from the straight line
    between their neighbours by much more than usual, and by no less than these do."""
    if len(knot_s) < 3:
        return basis
    share = ((knot_s[1:-1] - knot_s[:-2]) / (knot_s[2:] - knot_s[:-2]))[:, None, None]
    off = np.linalg.norm(basis[1:-1] - (1 - share) * basis[:-2] - share * basis[2:], axis=2).max(axis=1)
    off = np.where(np.diff(knot_s)[1:] + np.diff(knot_s)[:-1] <= 2 * gap_s, np.nan_to_num(off), 0.0)
    usual = np.median(off[off > 0]) if (off > 0).any() else np.inf
    beside = np.maximum(np.append(off[1:], 0.0), np.append(0.0, off[:-1]))
    spikes = 1 + np.flatnonzero((off > SPIKE * usual) & (off >= beside))
    basis = basis.copy()
    basis[spikes[~reliable[spikes]]] = np.nan
    return basis


def interpolate_missing(knot_s: Array, basis: Array, gap_s: float) -> Array:
    """The positions (K, B, 3) with missing ones interpolated linearly between neighbours at most `gap_s` apart."""
    known = np.flatnonzero(np.isfinite(basis).all(axis=(1, 2)))
    if len(known) < 2:
        return basis
    after = np.clip(np.searchsorted(knot_s[known], knot_s), 1, len(known) - 1)
    a, b = known[after - 1], known[after]
    share = ((knot_s - knot_s[a]) / (knot_s[b] - knot_s[a]))[:, None, None]
    near = (knot_s[b] - knot_s[a] <= gap_s)[:, None, None] & (share >= 0) & (share <= 1)
    between = np.where(near, (1 - share) * basis[a] + share * basis[b], np.nan)
    return np.where(np.isfinite(basis), basis, between)
