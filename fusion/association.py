# SPDX-License-Identifier: BSD-3-Clause
"""Which detection is of which marker, while robots are tracked.

Each marker is predicted into each frame at the frame's own time; within a gate of its covariance and apparent size,
detections are assigned globally, frame by frame: no detection is of two markers. The cost of a pair is its negative
log-likelihood (Bar-Shalom et al. 2001, section 6.4), so that a vague prediction does not take what an exact one fits.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from camera_node.pose import skew
from fusion.instants import Frame, Instant
from fusion.optics import Discs, Exposures, Optics, Views
from fusion.sightings import Catalogue, Matches, Sightings
from fusion.state import OMEGA, POSITION, THETA, VELOCITY, States

Array = NDArray[np.float64]
Index = NDArray[np.intp]
GATE = 13.8  # chi-square with 2 degrees: one detection in a thousand is lost to it
SLACK_PX = 0.7  # what a calibration may be off, added to the gate
SIZE_RATIO = 1.35  # between the measured and the predicted major axis, at the most
SIZE_SIGMA = 0.05  # of the logarithm of that, where the distance is known: diameters as declared
GRAZING = 0.1  # cosine between the line of sight and the normal under which a print is not read
UNMATCHED = 1e4  # the cost of leaving a marker unseen: more than any sum of costs within gates
TOGETHER = 150  # contested pairs that are assigned in one go, frames and all
TINY_PX2 = 1e-6  # squared half axis: what is nearer than its own radius has no outline
FRAME_STEP = 1e6  # keeps the frames' x apart on one sorted axis


@dataclass(frozen=True, slots=True, eq=False)
class _Pairs:
    """Candidates: row of the prediction, row of the sighting, and what the pair costs."""

    marker: Index
    sighting: Index
    cost: Array


@dataclass(frozen=True, slots=True, eq=False)
class _Expected:
    """M markers of robots that are followed: their rows in the catalogue, and how well their places are predicted.

    At a capture time tau after the instant the covariance (3, 3, M) of a place is `at + tau * rate + tau^2 * drift`.
    """

    markers: Index
    at: Array
    rate: Array
    drift: Array

    @classmethod
    def of(cls, states: States, catalogue: Catalogue, active: NDArray[np.bool_]) -> "_Expected":
        markers = np.flatnonzero(active[catalogue.robot])
        owner, marker = catalogue.robot[markers], catalogue.marker[:, markers].T
        R, P = states.R[owner], states.P[owner]
        arm = np.einsum("nij,nj->ni", R, marker)
        by_turn, by_rate = -R @ skew(marker), -skew(arm)  # of a place, and of its velocity
        place, velocity = by_turn @ P[:, THETA] + P[:, POSITION], by_rate @ P[:, OMEGA] + P[:, VELOCITY]
        by_turn, by_rate = by_turn.transpose(0, 2, 1), by_rate.transpose(0, 2, 1)
        at = place[:, :, THETA] @ by_turn + place[:, :, POSITION]
        both = place[:, :, OMEGA] @ by_rate + place[:, :, VELOCITY]
        drift = velocity[:, :, OMEGA] @ by_rate + velocity[:, :, VELOCITY]
        columns = (at, both + both.transpose(0, 2, 1), drift)
        return cls(markers, *(np.ascontiguousarray(C.transpose(1, 2, 0)) for C in columns))

    def covariance(self, tau: Array) -> Array:
        """(3, 3, F * M) at the times of F frames."""
        tau = tau[:, None]
        C = self.at[:, :, None] + tau * self.rate[:, :, None] + tau**2 * self.drift[:, :, None]
        return C.reshape(3, 3, -1)


class Association:
    """An instant's detections matched to robots, as many frames at a time as there are.

    Args:
        optics: the cameras.
        catalogue: the robots' markers.
        states: the robots as predicted at `t_ns`.
        active: (N,) those whose markers are looked for.
        t_ns: the instant.
        floor_px: see `Sightings.of`.
    """

    def __init__(
        self,
        optics: Optics,
        catalogue: Catalogue,
        states: States,
        active: NDArray[np.bool_],
        t_ns: int,
        floor_px: float,
    ) -> None:
        self._optics, self._catalogue, self._states = optics, catalogue, states
        self._expected = _Expected.of(states, catalogue, active)
        self._t_ns, self._floor_px = t_ns, floor_px
        self._done: dict[int, tuple[Frame, Matches]] = {}  # by the frame's id(), each with its rows from 0

    def missing(self, frames: Sequence[Frame]) -> tuple[Frame, ...]:
        """Those of the frames that are not matched yet."""
        return tuple(frame for frame in frames if id(frame) not in self._done)

    def add(self, frames: Sequence[Frame]) -> None:
        """Match those of the frames that are not matched yet, all at once."""
        new = self.missing(frames)
        if new:
            sightings = Sightings.of(Instant(self._t_ns, new), self._optics, self._floor_px)
            parts = self._match(sightings).split([len(frame.roundels) for frame in new])
            self._done |= {id(frame): (frame, part) for frame, part in zip(new, parts, strict=True)}

    def whole(self, instant: Instant) -> tuple[Sightings, Matches]:
        """All detections of the instant, and what they are matched to."""
        self.add(instant.frames)
        sightings = Sightings.of(instant, self._optics, self._floor_px)
        counts = [len(frame.roundels) for frame in instant.frames]
        return sightings, Matches.stack([self._done[id(frame)][1] for frame in instant.frames], counts)

    def _match(self, sightings: Sightings) -> Matches:
        exposures, markers = sightings.exposures, self._expected.markers
        if not len(sightings) or not len(markers):
            return Matches.none()
        n_frames = len(exposures.camera)
        rows = np.tile(markers, n_frames)
        discs = self._catalogue.discs(rows, np.repeat(np.arange(n_frames), len(markers)))
        views = self._optics.view(self._optics.pose(self._states, exposures), discs)
        spread, depth = _spread(self._optics, exposures, self._expected.covariance(exposures.tau), views)
        pairs = _candidates(self._optics, discs, views, spread, depth, sightings)
        chosen = _assign(pairs, discs.frame)
        return Matches.of(pairs.sighting[chosen], rows[pairs.marker[chosen]])


def _spread(optics: Optics, exposures: Exposures, C: Array, views: Views) -> tuple[Array, Array]:
    """Of places with covariances C (3, 3, F * M) in the world: (3, F * M) variance of x, covariance, and variance of y
    in the undistorted plane, and (F * M,) variance of the depth's logarithm."""
    R = optics.R_cam_world[exposures.camera]
    n_markers = C.shape[2] // len(R)
    R = np.repeat(R.transpose(1, 2, 0), n_markers, axis=2)
    g = (R[:2] - views.xy[:, None] * R[2]) / views.centre[2]
    x, y, along = (np.einsum("in,ijn->jn", row, C) for row in (g[0], g[1], R[2]))
    spread = np.stack([_dot(x, g[0]), _dot(x, g[1]), _dot(y, g[1])])
    return spread, _dot(along, R[2]) / views.centre[2] ** 2


def _candidates(
    optics: Optics, discs: Discs, views: Views, spread: Array, depth: Array, sightings: Sightings
) -> _Pairs:
    """Detections within the gates of visible markers, found along x and then tested."""
    noise = _noise(sightings)
    visible = np.flatnonzero((views.facing > GRAZING) & np.isfinite(views.xy[0]))
    worst = np.fmax.reduce(noise[[0, 2]], axis=1)[:, None]  # NaN where the lens has no inverse
    xy, reach = views.xy.take(visible, 1), np.sqrt(GATE * (spread[[0, 2]].take(visible, 1) + worst))
    i, j = _windows(discs.frame[visible], xy, reach, sightings)
    u, v = sightings.xy.take(j, 1) - xy.take(i, 1)
    i = visible[i]
    xx, xy, yy = spread.take(i, 1) + noise.take(j, 1)
    det = xx * yy - xy * xy
    d2 = (yy * u * u - 2 * xy * u * v + xx * v * v) / det
    near = np.flatnonzero(d2 < GATE)
    i, j, d2, det = i[near], j[near], d2[near], det[near]
    size = np.log(sightings.axes_px[0, j] / _major_px(discs, views, sightings, i, j))
    fits = np.flatnonzero(~(np.abs(size) > np.log(SIZE_RATIO)))  # an unknown size, NaN, excludes nothing
    i, j, variance = i[fits], j[fits], SIZE_SIGMA**2 + depth[i[fits]]
    unlike = np.nan_to_num(size[fits]) ** 2 / variance
    cost = d2[fits] + unlike + np.log(det[fits] * optics.focal[sightings.camera[j]] ** 4 * variance)
    return _Pairs(i, j, cost)


def _major_px(discs: Discs, views: Views, sightings: Sightings, i: Index, j: Index) -> Array:
    """(N,) full major axes that discs i would have where j were detected."""
    scale = sightings.scale.take(j, 2)
    shape = outlines(views.centre.take(i, 1), views.normal.take(i, 1), discs.radius[i], scale)
    a, b, c = shape[:, 0, 0], shape[:, 0, 1], shape[:, 1, 1]
    largest = (a + c + np.sqrt((a - c) ** 2 + 4 * b * b)) / 2  # eigenvalue
    return 2 * np.sqrt(np.maximum(largest, TINY_PX2))


def outlines(centre: Array, normal: Array, radius: Array, scale: Array) -> Array:
    """(N, 2, 2) shape matrices of discs' outlines in raw pixels; a circle of radius a has a^2 I.

    `centre` and `normal` (3, N) are in the camera's frame; `scale` (2, 2, N) is the derivative of raw pixels by xy at
    the disc: the lens is taken as affine over it.
    """
    dual = centre[:, None] * centre - radius**2 * (np.eye(3)[:, :, None] - normal[:, None] * normal)
    dual = dual / dual[2, 2]
    shape = dual[:2, None, 2] * dual[None, :2, 2] - dual[:2, :2]
    return np.einsum("ian,abn,jbn->nij", scale, shape, scale)


def _noise(sightings: Sightings) -> Array:
    """(3, N) the detections' noise in the undistorted plane, with the calibration's: as `_spread` tells it."""
    (a, b), (c, d) = sightings.scale
    p, q, r = sightings.cov[0, 0] + SLACK_PX**2, sightings.cov[0, 1], sightings.cov[1, 1] + SLACK_PX**2
    xx = d * d * p - 2 * d * b * q + b * b * r
    xy = (a * d + b * c) * q - c * d * p - a * b * r
    yy = c * c * p - 2 * c * a * q + a * a * r
    return np.stack([xx, xy, yy]) / (a * d - b * c) ** 2


def _dot(a: Array, b: Array) -> Array:
    """(N,) products of columns (3, N)."""
    return np.einsum("in,in->n", a, b)


def _windows(frame: Index, xy: Array, reach: Array, sightings: Sightings) -> tuple[Index, Index]:
    """Pairs (row, sighting) of one frame whose xy differ by less than `reach`; by sorting x, for all frames at once."""
    known = np.flatnonzero(np.isfinite(sightings.xy[0]))
    key = sightings.frame[known] * FRAME_STEP + sightings.xy[0, known]
    order = np.argsort(key)
    key, known = key[order], known[order]
    x, reach_x = frame * FRAME_STEP + xy[0], np.minimum(reach[0], FRAME_STEP / 10)
    first = np.searchsorted(key, x - reach_x)
    count = np.searchsorted(key, x + reach_x) - first
    i = np.repeat(np.arange(len(x)), count)
    place = np.arange(len(i)) + np.repeat(first - np.cumsum(count) + count, count)
    off = sightings.xy[1].take(known).take(place) - xy[1].take(i)
    near = np.flatnonzero(np.abs(off) < reach[1].take(i))
    return i[near], known[place[near]]


def _assign(pairs: _Pairs, frame: Index) -> Index:
    """The rows of the cheapest pairs, as many as there can be; what has no rival needs no search."""
    rivals = np.maximum(np.bincount(pairs.marker)[pairs.marker], np.bincount(pairs.sighting)[pairs.sighting])
    alone, contested = np.flatnonzero(rivals == 1), np.flatnonzero(rivals > 1)
    at = frame[pairs.marker[contested]]
    parts = [contested] if len(contested) < TOGETHER else [contested[at == k] for k in set(at.tolist())]
    return np.concatenate([alone, *(_assign_rivals(pairs, part) for part in parts)])


def _assign_rivals(pairs: _Pairs, rows: Index) -> Index:
    i, n = _renumber(pairs.marker[rows])
    j, m = _renumber(pairs.sighting[rows])
    costs, number = np.full((n, m), UNMATCHED), np.full((n, m), -1)
    costs[i, j], number[i, j] = pairs.cost[rows], rows
    chosen = number[linear_sum_assignment(costs)]
    return chosen[chosen >= 0]


def _renumber(rows: Index) -> tuple[Index, int]:
    """Rows counted from 0 without gaps, and how many there are."""
    new = np.cumsum(np.bincount(rows) > 0)
    return new[rows] - 1, int(new[-1]) if len(new) else 0
