# SPDX-License-Identifier: BSD-3-Clause
"""Finds the time at which a camera took its frames, from the trajectories of robots that other cameras tracked.

Each pair of a detection and the image trajectory of a marker votes for the time at which the marker passed there
(a Hough transform over time). If the clock is wrong, the votes of all robots agree; if the camera was moved, they do
not, or not with robots that stand still. See docs/design/time_offsets.md.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from camera_node.foundation.arrays import Array, Index, Mask
from fusion.model.frames import CalibratedFrame
from fusion.model.observations import CameraArray, Exposures, MarkerTable
from fusion.model.states import Snapshot, States

RANGE_S = 1.25  # largest offset that is searched for
BIN_S = 0.004
WINDOW_S = 0.012  # votes within this of a peak belong to it
CROSS_PX = 2.5  # largest distance of a detection from a trajectory
MIN_SPEED_PX_S = 15.0  # of a marker that votes
MIN_SHARE = 0.6  # of the moving markers that must vote for the peak
MIN_VOTES = 12
MAX_RIVAL = 0.6  # of the votes of a second peak, relative to the first
MIN_FACING, MARGIN_PX = 0.35, 20.0  # of markers that a camera is certain to see
APART_PX2 = (
    25.0  # squared deviations of the shifts from their mean, above which no moved camera explains them
)
NOISE_PX = 0.5  # of one vote
SMALL_S = 0.002  # an offset below this is none
MAX_ROBOTS = 6


@dataclass(frozen=True, slots=True, eq=False)
class TimeShift:
    """The result of a search.

    Attributes:
        offset_s, sigma_s: true capture time minus the time of the frames.
        share: of the moving markers that agree with it.
        n_expected: moving markers that the camera should have seen, in all frames.
        is_unique: whether no other offset explains nearly as many.
        is_told_apart: whether no shift of the image explains the same.
    """

    offset_s: float
    sigma_s: float
    share: float
    n_expected: int
    is_unique: bool
    is_told_apart: bool

    @property
    def is_zero(self) -> bool:
        """Whether the clock is right, as far as the motion shows."""
        return abs(self.offset_s) < max(SMALL_S, 3 * self.sigma_s)

    def explains(self, n_markers: int) -> bool:
        """Whether the frames were taken at this offset, according to so many markers at least."""
        return self.share >= MIN_SHARE and self.is_unique and self.n_expected >= n_markers

    def resolves(self, offset_s: float) -> bool:
        """Whether the motion is fast enough to show such an offset."""
        return 6 * self.sigma_s < max(abs(offset_s), SMALL_S)


@dataclass(frozen=True, slots=True, eq=False)
class _Trajectories:
    """Image trajectories of M markers between S + 1 times: `uv` (S + 1, M, 2), `visible` (S + 1, M)."""

    t_ns: Index
    uv: Array
    visible: Mask


@dataclass(frozen=True, slots=True, eq=False)
class _Votes:
    """V votes: offset (V,), image velocity (V, 2), and the moving markers expected at each candidate offset."""

    offset_s: Array
    velocity: Array
    expected: Array


def find_time_shift(
    cameras: CameraArray,
    name: str,
    frames: Sequence[CalibratedFrame],
    history: Sequence[Snapshot],
    markers: MarkerTable,
) -> TimeShift | None:
    """The offset at which most detections of the camera `name` lie on trajectories; None without any vote."""
    trajectories = _trajectories(cameras, name, history, markers)
    if trajectories is None or not frames:
        return None
    votes = _votes(frames, [frame.delays(cameras[name]) for frame in frames], trajectories)
    if len(votes.offset_s) < MIN_VOTES:
        return None
    return _peak(votes)


def _trajectories(
    cameras: CameraArray, name: str, history: Sequence[Snapshot], markers: MarkerTable
) -> _Trajectories | None:
    """Of the fastest robots that were tracked all the time."""
    if len(history) < 3:
        return None
    n_robots = len(history[-1].tracked)
    share = np.mean([snapshot.tracked for snapshot in history], axis=0)
    speed = np.mean(
        [np.linalg.norm(s.states.v, axis=1) for s in history[:: max(1, len(history) // 8)]], axis=0
    )
    robots = np.argsort(np.where(share > 0.5, -speed, np.inf))[:MAX_ROBOTS]
    rows = np.flatnonzero(np.isin(markers.robot, robots[share[robots] > 0.5]))
    if not len(rows):
        return None
    states = [snapshot.states for snapshot in history]
    joined = States(*(np.concatenate([getattr(s, k) for s in states]) for k in States.__slots__))
    discs = markers.discs(np.tile(rows, len(history)), np.zeros(len(rows) * len(history), np.intp))
    body = np.repeat(np.arange(len(history)) * n_robots, len(rows)) + discs.body
    camera = cameras.index[name]
    exposures = Exposures.exact(np.array([camera]), np.zeros(1))
    views = cameras.views(joined, exposures, replace(discs, body=body))
    lens, shape = cameras[name], (len(history), len(rows))
    uv = lens.project(views.q.T).reshape(*shape, 2)
    tracked = np.array([snapshot.tracked for snapshot in history])[:, markers.robot[rows]]
    inside = ((uv > MARGIN_PX) & (uv < np.array([lens.width, lens.height]) - MARGIN_PX)).all(2)
    visible = inside & (views.facing.reshape(shape) > MIN_FACING) & tracked
    return _Trajectories(np.array([snapshot.t_ns for snapshot in history]), uv, visible)


def _votes(frames: Sequence[CalibratedFrame], delays: Sequence[Array], trajectories: _Trajectories) -> _Votes:
    """Of frames whose detections (N,) were captured `delays` (N,) later."""
    t_ns, uv = trajectories.t_ns, trajectories.uv
    begin, along = uv[:-1], np.diff(uv, axis=0)
    dt = np.diff(t_ns)[:, None] * 1e-9
    length2 = np.sum(along**2, 2)
    moving = trajectories.visible[:-1] & trajectories.visible[1:] & (length2 > (MIN_SPEED_PX_S * dt) ** 2)
    s, m = np.nonzero(moving & (dt < 0.2))
    begin, along, length2, dt = begin[s, m], along[s, m], length2[s, m], dt[s, 0]
    offsets, velocities, expected = [], [], np.zeros(_n_bins())
    for frame, delay_s in zip(frames, delays, strict=True):
        start_s = np.asarray((t_ns[s] - frame.t_ns) * 1e-9, float)
        off = frame.roundels.uv[None] - begin[:, None]
        share = np.einsum("kdi,ki->kd", off, along) / length2[:, None]
        cross = (
            np.abs(off[..., 0] * along[:, None, 1] - off[..., 1] * along[:, None, 0])
            / np.sqrt(length2)[:, None]
        )
        k, d = np.nonzero(
            (share >= 0) & (share < 1) & (cross < CROSS_PX) & (np.abs(start_s) < RANGE_S)[:, None]
        )
        offsets.append(start_s[k] + share[k, d] * dt[k] - delay_s[d])
        velocities.append(along[k] / dt[k, None])
        expected += _coverage(start_s, dt)
    return _Votes(np.concatenate(offsets), np.concatenate(velocities), expected)


def _n_bins() -> int:
    return 2 * round(RANGE_S / BIN_S) + 1


def _bin(offset_s: Array) -> Index:
    return np.clip(np.round(offset_s / BIN_S).astype(int) + _n_bins() // 2, 0, _n_bins() - 1)


def _coverage(start_s: Array, dt: Array) -> Array:
    """(bins,) how many moving markers are expected if a frame was taken at each candidate offset."""
    n = _n_bins()
    first, last = _bin(start_s), _bin(start_s + dt)
    change = np.bincount(first, minlength=n + 1) - np.bincount(last, minlength=n + 1)
    return np.cumsum(change)[:n].astype(float)


def _peak(votes: _Votes) -> TimeShift:
    reach = round(WINDOW_S / BIN_S)
    histogram = np.bincount(_bin(votes.offset_s), minlength=_n_bins()).astype(float)
    smooth = np.convolve(histogram, np.ones(2 * reach + 1), "same")
    share = np.where(votes.expected >= MIN_VOTES, smooth / np.maximum(votes.expected, 1), 0.0)
    best = int(np.argmax(share))
    others = share.copy()
    others[max(0, best - 3 * reach) : best + 3 * reach + 1] = 0
    centre = (best - _n_bins() // 2) * BIN_S
    for width in (1.5 * WINDOW_S, WINDOW_S):
        near = np.abs(votes.offset_s - centre) < width
        weight = np.sum(votes.velocity[near] ** 2, 1)
        if not len(weight):
            return TimeShift(0.0, np.inf, 0.0, int(votes.expected[best]), False, False)
        centre = float(np.average(votes.offset_s[near], weights=weight))
    shifts = centre * votes.velocity[near]
    apart = float(np.sum((shifts - shifts.mean(0)) ** 2)) > APART_PX2
    sigma = NOISE_PX / float(np.sqrt(weight.sum()))
    unique = bool(others.max() < MAX_RIVAL * share[best])
    return TimeShift(centre, sigma, float(share[best]), int(votes.expected[best]), unique, apart)
