# SPDX-License-Identifier: BSD-3-Clause
"""Which end is which of a wand of two markers that look alike.

To swap the ends in all frames of all cameras changes nothing; to swap them in one camera does. From frame to frame of a
camera the stick turns little: frames chain into segments with one unknown sign each. Between cameras, rays to the same
end meet and those to different ends do not: for two segments that overlap in time, the epipolar residuals of both
namings say by how much one sign is likelier (`_evidence`). All signs together are a synchronisation over Z2 (Singer
2011): the spanning tree of the surest evidence, then each sign by all that speaks for it.

The cameras' places that this takes come from the stick's middle, waved as if it were one marker: the middle of two
image points is nearly the image of the middle, with no need of names. Then once more from the named ends.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from calib.wand.detections import FrameTable, WandDetections
from calib.wand.initialization.initial_rig import InitialRig, find_start
from calib.wand.initialization.two_view import INTERPOLATED, SLOWEST_S, TwoViewGeometry, sampson
from calib.wand.trajectory import finite_velocities, hermite
from camera_node.arrays import Array, Index
from camera_node.geometry.body import Body
from camera_node.geometry.lens import Lens
from camera_node.geometry.pose import invert, skew

if TYPE_CHECKING:
    from scipy.sparse import coo_array


FIRM = 0.5  # of the change that a swap would be: a turn of 53 degrees; more, and the sign is open
CHAINED_S = 0.2  # or a frame and a half: after so long a stick may lie anywhere
CLEAR = 3.0  # times what the stick usually turns from frame to frame: a longer one was not turned around
FASTEST = 1.0  # of the image plane a second, where no two frames tell how fast it turns
SAME_S = 5e-4  # frames nearer to each other in time are taken at once
ROUGH_PX, FINE_PX = 3.0, 1.5  # of epipolar residuals: by middles, and by ends
SURE = 6.0  # in the logarithm of the likelihood: a sign that less speaks for is not told
APART_S = 1e4  # that is set between runs, so that nothing is interpolated from one to the next


@dataclass(frozen=True, slots=True)
class _Sticks:
    """Frames with two detections, by camera and time.

    Attributes:
        rows: (n, 2) their sightings, in the order that makes neighbours of a segment alike.
        camera, t_s: (n,).
        xy: (n, 2, 2) both ends, image plane coordinates.
        run: (n,) ascending: frames of a camera over which the stick turns little, between which it is interpolated.
        segment: (n,) ascending: parts of runs over which it surely was not turned around.
    """

    rows: Index
    camera: Index
    t_s: Array
    xy: Array
    run: Index
    segment: Index

    def along(self) -> NDArray[np.complex128]:
        """(n,) from the first end to the second, as complex numbers."""
        gap = self.xy[:, 1] - self.xy[:, 0]
        return gap[:, 0] + 1j * gap[:, 1]


def label_ends(frames: FrameTable, seen: WandDetections, wand: Body, lenses: Sequence[Lens]) -> Index:
    """The end (n,), 0 or 1, that each sighting in a frame of two is; -1 where nothing tells."""
    sticks = _chain(seen, frames.period_s())
    labels = np.full(len(seen), -1, np.intp)
    if not len(sticks.rows):
        return labels
    period_s, cameras = frames.period_s(), range(len(lenses))
    light = Body(diameter_m=wand.diameter_m)
    start = find_start(TwoViewGeometry(_middles(seen, sticks), lenses, light, period_s), cameras)
    labels = _name(sticks, _signs(sticks, start, lenses, period_s, ROUGH_PX), len(seen))
    if not (labels >= 0).any():
        return labels
    named = replace(seen, label=labels).select(labels >= 0)
    finer = find_start(TwoViewGeometry(named, lenses, wand, period_s), cameras)
    if len(finer.poses) < len(start.poses):
        return labels
    return _name(sticks, _signs(sticks, finer, lenses, period_s, FINE_PX), len(seen))


def _chain(seen: WandDetections, period_s: float) -> _Sticks:
    """Chain frames of two detections into runs, and cut these into segments."""
    rows = np.flatnonzero((np.bincount(seen.frame) == 2)[seen.frame]).reshape(-1, 2)
    camera, t_s = seen.camera[rows[:, 0]], seen.t_s[rows[:, 0]]
    rows = rows[
        (np.diff(camera, prepend=-1) != 0) | (np.diff(t_s, prepend=0) > 0)
    ]  # without frames that came twice
    sticks = _sticks(seen, rows, np.arange(len(rows)))
    sign, run = _follow(sticks.camera, sticks.t_s, sticks.along(), max(CHAINED_S, 1.5 * period_s))
    rows = np.where(sign[:, None] > 0, rows, rows[:, ::-1])
    whole = run == np.minimum.accumulate(run[::-1])[::-1]  # without what lies within another run
    return _cut(_sticks(seen, rows[whole], run[whole]))


def _sticks(seen: WandDetections, rows: Index, run: Index) -> _Sticks:
    return _Sticks(rows, seen.camera[rows[:, 0]], seen.t_s[rows[:, 0]], seen.xy[rows], run, run)


def _cut(sticks: _Sticks) -> _Sticks:
    """Runs cut where the stick is so short in the image that it may have been turned around from frame to frame."""
    shorter = np.minimum(abs(sticks.along()[1:]), abs(sticks.along()[:-1]))
    cut = (np.diff(sticks.run) > 0) | (shorter < CLEAR * _usual_turn(sticks) * np.diff(sticks.t_s))
    return replace(sticks, segment=np.concatenate([[0], np.cumsum(cut)])[: len(sticks.run)])


def _usual_turn(sticks: _Sticks) -> float:
    """By how much a second a stick's image usually changes at the most."""
    within = np.flatnonzero(np.diff(sticks.run) == 0)
    speed = abs(np.diff(sticks.along()))[within] / np.diff(sticks.t_s)[within]
    return 2 * float(np.median(speed)) if len(speed) else FASTEST


def _follow(camera: Index, t_s: Array, along: NDArray[np.complex128], limit_s: float) -> tuple[Array, Index]:
    """Signs (n,) that make each stick like the one before it, and the number of its run, that of its first frame.

    A frame that does not fit stands alone, and what comes after is chained to the one before it: of two detections,
    one may be wrong.
    """
    sign, run = np.ones(len(along)), np.arange(len(along))
    last = alone = -1
    for k in range(len(along)):
        for j in (last, alone):
            near = j >= 0 and camera[j] == camera[k] and t_s[k] - t_s[j] <= limit_s
            if near and (told := _same_way(sign[j] * along[j], along[k])):
                sign[k], run[k] = told, run[j]
                break
        fresh = last < 0 or camera[last] != camera[k] or t_s[k] - t_s[last] > limit_s
        last, alone = (k, -1) if run[k] != k or fresh else (last, k)
    return sign, run


def _same_way(before: complex, now: complex) -> int:
    """1 where a stick in the image is as it was, -1 where its ends are the other way round, 0 where it is not clear."""
    kept, swapped = abs(now - before), abs(now + before)
    return 1 if kept < FIRM * swapped else -1 if swapped < FIRM * kept else 0


def _middles(seen: WandDetections, sticks: _Sticks) -> WandDetections:
    """The sticks' middles, as sightings of one marker without a size."""
    first = seen.select(sticks.rows[:, 0])
    unknown = np.full(len(first), np.nan)
    return replace(
        first,
        label=np.zeros(len(first), np.intp),
        uv=seen.uv[sticks.rows].mean(axis=1),
        xy=sticks.xy.mean(axis=1),
        axes_px=np.column_stack([unknown, unknown]),
        angle_rad=unknown,
    )


def _name(sticks: _Sticks, signs: Index, sightings: int) -> Index:
    """Labels (n,) of all sightings, by the sign of every segment, 0 where it is not known."""
    labels, sign = np.full(sightings, -1, np.intp), signs[sticks.segment]
    known = sign != 0
    labels[sticks.rows[known]] = np.where(sign[known, None] > 0, [0, 1], [1, 0])
    return labels


def _signs(
    sticks: _Sticks, start: InitialRig, lenses: Sequence[Lens], period_s: float, sigma_px: float
) -> Index:
    """(S,) 1 or -1 by segment, 0 where what speaks for it is not enough. Of cameras that have no place, segments stay
    as they are: what is wrong with these is told by those who look for it."""
    count, edges, placed = int(sticks.segment.max()) + 1, [], sorted(start.poses)
    gap_s = min(INTERPOLATED * period_s, SLOWEST_S) if period_s else SLOWEST_S
    apart_s = sticks.t_s + APART_S * sticks.run
    velocity = finite_velocities(apart_s, sticks.xy, gap_s)
    for a in placed:
        for b in placed:
            if a < b:
                sigma = sigma_px / np.mean([lenses[a].fx, lenses[b].fx])
                edges.append(_evidence(sticks, velocity, start, (a, b), gap_s, float(sigma)))
    edges += [_turns(sticks, gap_s, lag) for lag in (1, 2)]  # of three frames, the middle one may be wrong
    signs = _synchronise(count, *(np.concatenate(column) for column in zip(*edges, strict=True)))
    signs[sticks.segment[~np.isin(sticks.camera, placed)]] = 1
    return signs


def _turns(sticks: _Sticks, gap_s: float, lag: int) -> tuple[Index, Index, Array]:
    """What frames of a camera, `lag` apart, say of their segments' signs, by Cauchy's density of the stick's turn."""
    k = np.arange(len(sticks.rows) - lag)
    k = k[(sticks.segment[k] < sticks.segment[k + lag]) & (sticks.camera[k] == sticks.camera[k + lag])]
    k = k[sticks.t_s[k + lag] - sticks.t_s[k] <= gap_s]
    before, now = sticks.along()[k], sticks.along()[k + lag]
    usual = _usual_turn(sticks) * (sticks.t_s[k + lag] - sticks.t_s[k])
    kept, swapped = (np.log1p((abs(now + sign * before) / usual) ** 2) for sign in (-1, 1))
    return sticks.segment[k], sticks.segment[k + lag], swapped - kept


def _evidence(
    sticks: _Sticks, velocity: Array, start: InitialRig, pair: tuple[int, int], gap_s: float, sigma: float
) -> tuple[Index, Index, Array]:
    """Segments of two cameras that overlap in time, (e,) each, and by how much their signs are likelier alike than
    unlike, in the logarithm, by Cauchy's density of epipolar residuals at `sigma`."""
    a, b = pair
    mine, theirs = np.flatnonzero(sticks.camera == a), np.flatnonzero(sticks.camera == b)
    if not len(mine) or len(theirs) < 2:
        return mine[:0], mine[:0], np.empty(0)
    t_s = sticks.t_s[mine] + start.offset_s[a] - start.offset_s[b]
    other, segment = _at(t_s, sticks, velocity, theirs, gap_s)
    T = invert(start.poses[b]) @ start.poses[a]
    E = skew(T[:3, 3]) @ T[:3, :3]
    far = [
        [np.log1p((sampson(E, sticks.xy[mine, i], other[:, j]) / sigma) ** 2) for j in (0, 1)] for i in (0, 1)
    ]
    gain = far[0][1] + far[1][0] - far[0][0] - far[1][1]
    known = np.isfinite(gain)
    return sticks.segment[mine[known]], segment[known], gain[known]


def _at(t_s: Array, sticks: _Sticks, velocity: Array, rows: Index, gap_s: float) -> tuple[Array, Index]:
    """Both ends (n, 2, 2) in the camera of the sticks `rows`, at its stamps `t_s` (n,), NaN where no segment is; and
    the segment."""
    stamps = sticks.t_s[rows]
    after = np.clip(np.searchsorted(stamps, t_s), 1, len(rows) - 1)
    left, right = rows[after - 1], rows[after]
    tau, dt = t_s - sticks.t_s[left], sticks.t_s[right] - sticks.t_s[left]
    h = hermite(tau, dt)
    ends = np.stack([sticks.xy[left], velocity[left], sticks.xy[right], velocity[right]], axis=1)
    found = np.einsum("nh,nhex->nex", h, ends)
    inside = (sticks.run[left] == sticks.run[right]) & (dt <= gap_s) & (tau >= 0) & (tau <= dt)
    nearest = np.where(tau > dt / 2, right, left)
    at_once = np.abs(sticks.t_s[nearest] - t_s) < SAME_S
    found = np.where(at_once[:, None, None], sticks.xy[nearest], found)
    found[~(inside | at_once)] = np.nan
    return found, sticks.segment[nearest]


def _synchronise(count: int, a: Index, b: Index, gain: Array) -> Index:
    """Signs (count,) that most evidence speaks for, 0 where it is not enough.

    Args:
        a, b, gain: (e,) by how much the signs of a and b are likelier alike than unlike; pairs may come again.
    """
    from scipy.sparse import coo_array

    graph = coo_array((np.tile(gain, 2), (np.append(a, b), np.append(b, a))), (count, count)).tocsr()
    signs = _span(graph.tocoo(), count)
    for _ in range(count):
        agreement = signs * (graph @ signs)
        if agreement[worst := int(agreement.argmin())] >= 0:
            break
        signs[worst] *= -1
    return np.where(signs * (graph @ signs) >= SURE, signs, 0).astype(np.intp)


def _span(graph: "coo_array", count: int) -> Array:
    """Signs (count,) along the spanning trees of the surest evidence (Kruskal)."""
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
