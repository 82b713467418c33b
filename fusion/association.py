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
from fusion.optics import Discs, Exposures, Optics, Views, outlines
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
    """Of places with covariances C (3, 3, F * M) in the world: (2, 2, F * M) covariance in the undistorted plane, and
    (F * M,) variance of the depth's logarithm."""
    R = optics.R_cam_world[exposures.camera]
    n_markers = C.shape[2] // len(R)
    across = np.repeat(R[:, :2, :].transpose(1, 2, 0), n_markers, axis=2)
    along = np.repeat(R[:, 2].T, n_markers, axis=1)
    g = (across - views.xy[:, None] * along) / views.centre[2]
    depth = np.einsum("in,ijn,jn->n", along, C, along) / views.centre[2] ** 2
    return np.einsum("ain,bin->abn", np.einsum("ain,ijn->ajn", g, C), g), depth


def _candidates(
    optics: Optics, discs: Discs, views: Views, spread: Array, depth: Array, sightings: Sightings
) -> _Pairs:
    """Detections within the gates of visible markers, found along x and then tested."""
    noise = noise_xy(sightings, SLACK_PX)
    visible = np.flatnonzero((views.facing > GRAZING) & np.isfinite(views.xy[0]))
    worst = np.array([[np.max(noise[0, 0])], [np.max(noise[1, 1])]])
    reach = np.sqrt(GATE * (spread[[0, 1], [0, 1]][:, visible] + worst))
    i, j = _windows(discs.frame[visible], views.xy[:, visible], reach, sightings)
    i = visible[i]
    S = spread[:, :, i] + noise[:, :, j]
    u, v = sightings.xy[:, j] - views.xy[:, i]
    det = S[0, 0] * S[1, 1] - S[0, 1] ** 2
    d2 = (S[1, 1] * u * u - 2 * S[0, 1] * u * v + S[0, 0] * v * v) / det
    near = d2 < GATE
    i, j, d2, det = i[near], j[near], d2[near], det[near]
    shape = outlines(views.centre[:, i], views.normal[:, i], discs.radius[i], sightings.scale[..., j])
    major_px = 2 * np.sqrt(np.maximum(np.linalg.eigvalsh(shape)[:, 1], TINY_PX2))
    size = np.log(sightings.axes_px[0, j] / major_px)
    fits = ~(np.abs(size) > np.log(SIZE_RATIO))  # an unknown size, NaN, excludes nothing
    i, j, variance = i[fits], j[fits], SIZE_SIGMA**2 + depth[i[fits]]
    unlike = np.nan_to_num(size[fits]) ** 2 / variance
    cost = d2[fits] + unlike + np.log(det[fits] * optics.focal[sightings.camera[j]] ** 4 * variance)
    return _Pairs(i, j, cost)


def noise_xy(sightings: Sightings, slack_px: float) -> Array:
    """(2, 2, N) the detections' noise in the undistorted plane; `slack_px` is added to it."""
    (a, b), (c, d) = sightings.scale
    inverse = np.stack([np.stack([d, -b]), np.stack([-c, a])]) / (a * d - b * c)
    cov = sightings.cov + slack_px**2 * np.eye(2)[:, :, None]
    return np.nan_to_num(np.einsum("ian,abn,jbn->ijn", inverse, cov, inverse))


def _windows(frame: Index, xy: Array, reach: Array, sightings: Sightings) -> tuple[Index, Index]:
    """Pairs (row, sighting) of one frame whose xy differ by less than `reach`; by sorting x, for all frames at once."""
    known = np.flatnonzero(np.isfinite(sightings.xy[0]))
    key = sightings.frame[known] * FRAME_STEP + sightings.xy[0, known]
    order = np.argsort(key)
    key = key[order]
    x, reach_x = frame * FRAME_STEP + xy[0], np.minimum(reach[0], FRAME_STEP / 10)
    first = np.searchsorted(key, x - reach_x)
    count = np.searchsorted(key, x + reach_x) - first
    i = np.repeat(np.arange(len(x)), count)
    within = np.arange(len(i)) - np.repeat(np.cumsum(count) - count, count)
    j = known[order[np.repeat(first, count) + within]]
    near = np.abs(sightings.xy[1, j] - xy[1, i]) < reach[1, i]
    return i[near], j[near]


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
