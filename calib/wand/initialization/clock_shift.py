# SPDX-License-Identifier: BSD-3-Clause
"""How far two cameras' clocks are apart, before anything is known of where they stand.

At the right shift, what both saw at once satisfies one epipolar constraint; at a wrong one the wand has moved on. For
every trial shift the fundamental matrix is fitted by the eight-point algorithm (Hartley 1997), robustly.
"""

from dataclasses import dataclass

import numpy as np

from calib.wand.tracks import MarkerTrack
from camera_node.arrays import Array, Index, Mask

RANGE_S = 0.32  # twice what clocks may be off
STEP_S = 0.01
SAMPLE = 500  # sightings that are tried
ROUNDS = 5  # of reweighting
# Clocks are together unless the data say otherwise: by this much in the logarithm of their likelihood, as the best of
# many trials is better by chance, and eight numbers were fitted to each.
EVIDENCE = 12.0
FITTED = 8
MIN_COMMON = 16
MIN_MOMENTS = (
    15  # at which both saw the wand; the markers of one moment tell little more than two of them would
)


@dataclass(frozen=True, slots=True)
class Common:
    """Sightings of camera a and where camera b saw the same markers at the same time: (n,) rows, (n, 2) each."""

    rows: Index
    xy_a: Array
    xy_b: Array


def common_sightings(
    tracks: list[MarkerTrack], rows: Index, label: Index, t_s: Array, xy: Array, shift_s: float, gap_s: float
) -> Common:
    """Sightings `rows` with those of another camera, whose `tracks` are by marker and stamped `shift_s` later."""
    other = interpolate(tracks, label, t_s + shift_s, gap_s)
    good = np.isfinite(other[:, 0])
    return Common(rows[good], xy[good], other[good])


def interpolate(tracks: list[MarkerTrack], label: Index, t_s: Array, gap_s: float) -> Array:
    """(..., n, 2) positions of the markers `label` (n,) at times (..., n)."""
    found = np.full((*t_s.shape, 2), np.nan)
    for marker, track in enumerate(tracks):
        mine = label == marker
        found[..., mine, :] = track.interpolate(t_s[..., mine], gap_s)
    return found


def find_shift(tracks: list[MarkerTrack], label: Index, t_s: Array, xy: Array, gap_s: float) -> float:
    """The time by which camera b's stamps are later than camera a's, seconds; 0 where nothing tells.

    Args:
        tracks: camera b's, by marker.
        label, t_s, xy: (n,), (n,), (n, 2) camera a's sightings.
        gap_s: the longest time over which b's tracks are interpolated.
    """
    if not len(label):
        return 0.0
    chosen = np.linspace(0, len(label) - 1, min(SAMPLE, len(label))).round().astype(np.intp)
    label, t_s, xy = label[chosen], t_s[chosen], xy[chosen]
    coarse = STEP_S * np.arange(-round(RANGE_S / STEP_S), round(RANGE_S / STEP_S) + 1)
    misfits = misfit(xy, interpolate(tracks, label, t_s + coarse[:, None], gap_s))
    together = misfits[len(coarse) // 2]
    best = int(np.nanargmin(misfits)) if np.isfinite(misfits).any() else len(coarse) // 2
    common = np.isfinite(interpolate(tracks, label, t_s + coarse[best], gap_s)[:, 0])
    moments = len(np.unique(t_s[common]))
    told = min(int(common.sum()), 2 * moments) - FITTED
    if moments < MIN_MOMENTS or not together > misfits[best] * np.exp(EVIDENCE / told):
        return 0.0
    fine = coarse[best] + STEP_S * np.linspace(-1, 1, 11)
    misfits = misfit(xy, interpolate(tracks, label, t_s + fine[:, None], gap_s))
    return float(fine[np.nanargmin(misfits)]) if np.isfinite(misfits).any() else float(coarse[best])


def misfit(xy_a: Array, xy_b: Array) -> Array:
    """(S,) median distance from the epipolar constraint that fits best (Sampson), of S trials of n correspondences.

    Args:
        xy_a: (n, 2); xy_b: (S, n, 2), NaN where there is none. Trials with too few have inf.
    """
    known = np.isfinite(xy_b[..., 0])
    b = np.where(known[..., None], xy_b, 0.0)
    scale_a, scale_b = np.abs(xy_a).mean() + 1e-9, np.abs(b).mean() + 1e-9
    one = np.ones((*known.shape, 1))
    ha = np.concatenate([np.broadcast_to(xy_a / scale_a, b.shape), one], axis=2)
    hb = np.concatenate([b / scale_b, one], axis=2)
    products = (hb[..., :, None] * ha[..., None, :]).reshape(*known.shape, 9)
    weight, middle = known.astype(float), np.full(len(known), np.inf)
    for _ in range(ROUNDS):
        moments = np.swapaxes(products * weight[..., None], 1, 2) @ products
        F = np.linalg.eigh(moments)[1][:, :, 0].reshape(-1, 3, 3)
        off = np.abs(np.einsum("snk,sk->sn", products, F.reshape(-1, 9)))
        lines_b, lines_a = ha @ np.swapaxes(F, 1, 2), hb @ F
        slope = (lines_b[..., :2] / scale_b) ** 2, (lines_a[..., :2] / scale_a) ** 2
        miss = off / np.sqrt(slope[0].sum(axis=2) + slope[1].sum(axis=2) + 1e-18)
        middle = _masked_median(miss, known)
        weight = known / (1 + (miss / (2 * middle[:, None] + 1e-9)) ** 2)
    return np.where(known.sum(axis=1) >= MIN_COMMON, middle, np.inf)


def _masked_median(values: Array, known: Mask) -> Array:
    ordered = np.sort(np.where(known, values, np.inf), axis=1)
    middle = np.maximum(known.sum(axis=1) - 1, 0) // 2
    return np.nan_to_num(ordered[np.arange(len(ordered)), middle], posinf=1.0)
