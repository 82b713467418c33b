# SPDX-License-Identifier: BSD-3-Clause
"""Explains why cameras could not be placed: a wrong clock, a mirrored image, or too few common detections.

Each fault is tested by undoing it: if a camera fits another one after its timestamps are shifted, or its image is
mirrored, it has that fault.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from calib.wand.detections import FrameTable
from calib.wand.initialization.clock_shift import FITTED, epipolar_misfits, spread_evenly
from calib.wand.initialization.initial_rig import InitialRig
from calib.wand.initialization.two_view import MIN_FRAME_SETS, TwoViewGeometry
from calib.wand.tracks import interpolate
from camera_node.foundation.arrays import Index

# Inlier ratio and frames of two cameras once the fault is undone: a short piece of a smooth path fits many geometries.
MIN_RATIO, MIN_FRAMES = 0.8, 60
RANGE_S, STEP_S = 10.0, 0.04  # of the shifts of an unsynchronized clock
APART_S = 2.0  # least gap between recordings; cameras of one recording may start one after the other
MIN_MISFIT = 1e-6  # of the image plane
SAMPLE = 200  # detections that are used


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
    if _fits(_mirrored(pairs, k), k, other):
        return f"its image is mirrored against that of '{names[other]}'; disable the flip and record again"
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


def _fits(pairs: TwoViewGeometry, k: int, other: int) -> bool:
    found = pairs.relate(other, k)
    if found is None or found.inlier_ratio < MIN_RATIO:
        return False
    return len(np.unique(pairs.detections.t_s[list(found.depth)])) >= MIN_FRAMES


def _mirrored(pairs: TwoViewGeometry, k: int) -> TwoViewGeometry:
    """Return the geometry with the image of camera k flipped left to right."""
    detections, rows, lens = pairs.detections, pairs.rows[k], pairs.lenses[k]
    uv, xy = detections.uv.copy(), detections.xy.copy()
    uv[rows, 0] = lens.width - 1 - uv[rows, 0]
    xy[rows] = lens.normalise(uv[rows])
    valid = np.flatnonzero(np.isfinite(xy).all(axis=1))
    return pairs.with_detections(replace(detections, uv=uv, xy=xy).select(valid))


def _find_large_shift(pairs: TwoViewGeometry, k: int, other: int) -> float:
    """Return the shift by which camera k's timestamps are late, if it makes k fit the other camera; else 0."""
    detections, rows = pairs.detections, pairs.rows[other]
    rows = rows[spread_evenly(len(rows), SAMPLE)]
    shifts = STEP_S * np.arange(-round(RANGE_S / STEP_S), round(RANGE_S / STEP_S) + 1)
    times = detections.t_s[rows] + shifts[:, None]
    there = interpolate(pairs.tracks[k], detections.label[rows], times, pairs.gap_s)
    misfits = epipolar_misfits(detections.xy[rows], there)
    known = np.isfinite(misfits)
    if not known.any():
        return 0.0
    # Few correspondences fit an epipolar geometry by chance: the gain of a shift is weighted by their number.
    redundancy = np.isfinite(there[known, :, 0]).sum(axis=1) - FITTED
    gain = redundancy * np.log((np.median(misfits[known]) + MIN_MISFIT) / (misfits[known] + MIN_MISFIT))
    shift_s = float(shifts[known][gain.argmax()])
    t_s = detections.t_s.copy()
    t_s[pairs.rows[k]] -= shift_s
    return shift_s if _fits(pairs.with_detections(replace(detections, t_s=t_s)), k, other) else 0.0


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
        elif (ratio := max(ratios, default=0.0)) > 0:
            reasons[names[k]] = (
                f"its detections fit no other camera (at best {ratio:.0%} of the shared ones are inliers); "
                "check its name, its clock and its intrinsics"
            )
        else:
            overlap = ", ".join(f"{shared[k, j]} with {name}" for j, name in enumerate(names) if j != k)
            reasons[names[k]] = (
                f"frame sets shared with other cameras: {overlap}; at least {MIN_FRAME_SETS} consistent ones are "
                "needed; wave the wand where its view overlaps theirs"
            )
    return reasons
