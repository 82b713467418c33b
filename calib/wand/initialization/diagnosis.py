# SPDX-License-Identifier: BSD-3-Clause
"""Why a camera that saw the wand fits no other: a clock that is far off, or a mirrored image.

Each guess is tried: a camera that can be related to another one when its stamps are shifted, or its image is mirrored,
has that fault.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from calib.wand.detections import FrameTable, WandDetections
from calib.wand.initialization.clock_shift import FITTED, interpolate, misfit
from calib.wand.initialization.two_view import TwoViewGeometry

SURE = 0.8  # of the sightings that two cameras share must fit, once the fault is undone,
MANY = 60  # and so many frames of the two: a short piece of a smooth path fits many geometries
SEARCH_S, STEP_S = 10.0, 0.04  # by which clocks that nobody set are apart, and the step of the search
FAR_S = 2.0  # between recordings: of less, the cameras may have been started one after the other
NOTHING = 1e-6  # of the image plane: no misfit is better
SAMPLE = 200  # sightings that are tried


def find_faults(
    names: Sequence[str], frames: FrameTable, pairs: TwoViewGeometry, placed: Sequence[int]
) -> dict[str, str]:
    """The fault of each camera that is not placed, and what to do; cameras without one that is found are missing.

    Args:
        names: of the C cameras.
        frames: the recording's.
        pairs: what each two of them have in common.
        placed: numbers of the cameras that stand somewhere: others are compared with these, or with all where none do.
    """
    faults = {}
    for k in sorted(set(range(len(names))) - set(placed)):
        others = [j for j in (placed or range(len(names))) if j != k and len(pairs.rows[j])]
        if not others or not len(pairs.rows[k]):
            continue
        if apart := _apart_s(frames, k, others):
            faults[names[k]] = (
                f"its frames are {abs(apart):.0f} s {'later' if apart > 0 else 'earlier'} than those of all others: "
                "is its clock right? set it (by chrony or NTP) and record again"
            )
            continue
        other = max(others, key=lambda j: _together(frames, pairs, k, j))
        if _relates(_mirrored(pairs, k), k, other):
            faults[names[k]] = (
                f"its image is mirrored against that of '{names[other]}'; switch the flip off and record again"
            )
        elif shift_s := _shift_s(pairs, k, other):
            faults[names[k]] = (
                f"its stamps are {abs(shift_s):.2f} s {'later' if shift_s > 0 else 'earlier'} than those of "
                f"'{names[other]}'; set its clock (by chrony or NTP) and record again"
            )
    return faults


def _apart_s(frames: FrameTable, k: int, others: Sequence[int]) -> float:
    """By how much camera k's recording lies after (before, if negative) all others'; 0 where by little."""
    mine, theirs = frames.t_s[frames.camera == k], frames.t_s[np.isin(frames.camera, others)]
    after, before = float(mine.min() - theirs.max()), float(theirs.min() - mine.max())
    return after if after > FAR_S else -before if before > FAR_S else 0.0


def _together(frames: FrameTable, pairs: TwoViewGeometry, k: int, other: int) -> int:
    """Sightings of another camera while camera k recorded."""
    mine, t_s = frames.t_s[frames.camera == k], pairs.seen.t_s[pairs.rows[other]]
    return int(((t_s >= mine.min()) & (t_s <= mine.max())).sum())


def _relates(pairs: TwoViewGeometry, k: int, other: int) -> bool:
    found = pairs.relate(other, k)
    return (
        found is not None
        and found.share >= SURE
        and len(np.unique(pairs.seen.t_s[list(found.depth)])) >= MANY
    )


def _mirrored(pairs: TwoViewGeometry, k: int) -> TwoViewGeometry:
    """The same, had camera k not been mirrored left to right."""
    seen, rows, lens = pairs.seen, pairs.rows[k], pairs.lenses[k]
    uv, xy = seen.uv.copy(), seen.xy.copy()
    uv[rows, 0] = lens.width - 1 - uv[rows, 0]
    xy[rows] = lens.normalise(uv[rows])
    known = np.flatnonzero(np.isfinite(xy).all(axis=1))
    return _again(pairs, replace(seen, uv=uv, xy=xy).select(known))


def _shift_s(pairs: TwoViewGeometry, k: int, other: int) -> float:
    """By how much camera k's stamps are late where that makes it fit the other; 0 where no shift does."""
    seen, rows = pairs.seen, pairs.rows[other]
    rows = rows[np.linspace(0, len(rows) - 1, min(SAMPLE, len(rows))).round().astype(np.intp)]
    shifts = STEP_S * np.arange(-round(SEARCH_S / STEP_S), round(SEARCH_S / STEP_S) + 1)
    there = interpolate(pairs.tracks[k], seen.label[rows], seen.t_s[rows] + shifts[:, None], pairs.gap_s)
    misfits = misfit(seen.xy[rows], there)
    known = np.isfinite(misfits)
    if not known.any():
        return 0.0
    # Of few sightings an epipolar geometry is easily found: what a shift gains counts by how many agree to it.
    told = np.isfinite(there[known, :, 0]).sum(axis=1) - FITTED
    gain = told * np.log((np.median(misfits[known]) + NOTHING) / (misfits[known] + NOTHING))
    shift = float(shifts[known][gain.argmax()])
    t_s = seen.t_s.copy()
    t_s[pairs.rows[k]] -= shift
    return shift if _relates(_again(pairs, replace(seen, t_s=t_s)), k, other) else 0.0


def _again(pairs: TwoViewGeometry, seen: WandDetections) -> TwoViewGeometry:
    return TwoViewGeometry(seen, pairs.lenses, pairs.wand, pairs.period_s)
