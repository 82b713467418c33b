# SPDX-License-Identifier: BSD-3-Clause
"""Estimates the clock shift between two cameras whose relative pose is unknown.

At the right shift, simultaneous detections of both cameras satisfy one epipolar constraint; at a wrong shift the wand
has moved. The eight-point algorithm (Hartley 1997) fits a fundamental matrix robustly to each trial shift.
"""

from collections.abc import Sequence

import numpy as np

from calib.wand.detections import WandDetections
from calib.wand.tracks import MarkerTrack, interpolate
from camera_node.foundation.arrays import Array, Index, Mask

RANGE_S = 0.32  # largest trial shift: twice the difference of clocks that the server synchronizes
STEP_S = 0.01
SAMPLE = 500  # detections that are used
ROUNDS = 5  # of reweighting
# A shift is accepted if it raises the logarithm of the likelihood by this much: the best of many trials is better than
# no shift by chance, and the parameters of the fundamental matrix are fitted to each trial.
EVIDENCE = 12.0
FITTED = 8
MIN_COMMON = 16  # correspondences of a trial
MIN_TIMES = 15  # timestamps with correspondences; the markers of one frame add little information


def find_shift(tracks: Sequence[MarkerTrack], detections: WandDetections, gap_s: float) -> float:
    """Return how much later the timestamps of camera b are than those of a, seconds; 0 if the data show no shift.

    Args:
        tracks: of camera b, by marker.
        detections: of camera a.
        gap_s: the longest gap over which the tracks are interpolated.
    """
    if not len(detections):
        return 0.0
    detections = detections.select(spread_evenly(len(detections), SAMPLE))
    label, t_s, xy = detections.label, detections.t_s, detections.xy
    coarse = STEP_S * np.arange(-round(RANGE_S / STEP_S), round(RANGE_S / STEP_S) + 1)
    misfits = epipolar_misfits(xy, interpolate(tracks, label, t_s + coarse[:, None], gap_s))
    unshifted = misfits[len(coarse) // 2]
    best = int(np.nanargmin(misfits)) if np.isfinite(misfits).any() else len(coarse) // 2
    common = np.isfinite(interpolate(tracks, label, t_s + coarse[best], gap_s)[:, 0])
    times = len(np.unique(t_s[common]))
    if times < MIN_TIMES or not supports_shift(unshifted, misfits[best], int(common.sum()), times):
        return 0.0
    fine = coarse[best] + STEP_S * np.linspace(-1, 1, 11)
    misfits = epipolar_misfits(xy, interpolate(tracks, label, t_s + fine[:, None], gap_s))
    return float(fine[np.nanargmin(misfits)]) if np.isfinite(misfits).any() else float(coarse[best])


def spread_evenly(count: int, most: int) -> Index:
    """Return up to `most` indices below `count`, evenly spaced."""
    return np.linspace(0, count - 1, min(most, count)).round().astype(np.intp)


def supports_shift(unshifted: float, shifted: float, correspondences: int, times: int) -> bool:
    """Return whether the misfits without and with a shift show that the clocks differ."""
    return bool(unshifted > shifted * np.exp(EVIDENCE / (min(correspondences, 2 * times) - FITTED)))


def epipolar_misfits(xy_a: Array, xy_b: Array) -> Array:
    """Fit a fundamental matrix to each of S trials of n correspondences; return (S,) median Sampson distances.

    Args:
        xy_a: (n, 2) image plane coordinates in camera a.
        xy_b: (S, n, 2) in camera b; NaN without a correspondence. A trial with too few has an infinite misfit.
    """
    known = np.isfinite(xy_b[..., 0])
    b = np.where(known[..., None], xy_b, 0.0)
    scale_a, scale_b = np.abs(xy_a).mean() + 1e-9, np.abs(b).mean() + 1e-9
    one = np.ones((*known.shape, 1))
    ha = np.concatenate([np.broadcast_to(xy_a / scale_a, b.shape), one], axis=2)
    hb = np.concatenate([b / scale_b, one], axis=2)
    products = (hb[..., :, None] * ha[..., None, :]).reshape(*known.shape, 9)
    weight, median = known.astype(float), np.full(len(known), np.inf)
    for _ in range(ROUNDS):
        moments = np.swapaxes(products * weight[..., None], 1, 2) @ products
        F = np.linalg.eigh(moments)[1][:, :, 0].reshape(-1, 3, 3)
        off = np.abs(np.einsum("snk,sk->sn", products, F.reshape(-1, 9)))
        lines_b, lines_a = ha @ np.swapaxes(F, 1, 2), hb @ F
        slope = (lines_b[..., :2] / scale_b) ** 2, (lines_a[..., :2] / scale_a) ** 2
        distance = off / np.sqrt(slope[0].sum(axis=2) + slope[1].sum(axis=2) + 1e-18)
        median = _masked_median(distance, known)
        weight = known / (1 + (distance / (2 * median[:, None] + 1e-9)) ** 2)
    return np.where(known.sum(axis=1) >= MIN_COMMON, median, np.inf)


def _masked_median(values: Array, known: Mask) -> Array:
    ordered = np.sort(np.where(known, values, np.inf), axis=1)
    middle = np.maximum(known.sum(axis=1) - 1, 0) // 2
    return np.nan_to_num(ordered[np.arange(len(ordered)), middle], posinf=1.0)
