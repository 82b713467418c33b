# SPDX-License-Identifier: BSD-3-Clause
"""Markers that are nobody's, followed from instant to instant: each is a robot of one marker without a name.

A grouping places a marker by rays of different times, as if it might move at `SPEED_M_S`; followed, its speed is
estimated with its place, and its normal with both, by the same estimator as that of robots.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from camera_node.arrays import Array, Index, Mask
from fusion import _core
from fusion.model.camera_array import CameraArray, Discs
from fusion.model.observations import DetectionTable, MatchedObservations
from fusion.model.robots import MOTIONS
from fusion.model.states import POSITION, States, Transition, forget_turn
from fusion.tracking.estimator import Estimator, Prediction, mean_of_bodies, misfit
from fusion.tracking.multiview import Marker
from fusion.tracking.normals import find_normal, rotation_to

BIRTH = (0.3, 0.05, 10.0, 1.5)  # sigmas of a marker just seen: rad, m, rad/s, m/s
MAX_CHI2 = 8.0  # mean squared Mahalanobis error of a marker's detections, with SLACK_PX for the calibration
SLACK_PX = 0.7
REACH = 16.3  # chi-square with 3 degrees, one in a thousand
FORGOTTEN_S = 0.3  # without being seen
NORMAL_RAD = 0.2  # standard deviation under which a normal is told


@dataclass(frozen=True, slots=True, eq=False)
class UnlabeledMarkers:
    """An instant's N markers of nobody: position, velocity and normal (N, 3), covariance (N, 3, 3) of the position.

    Velocity and normal are NaN where they are unknown. `candidates` (N, 2, 3) are the normals of what one camera alone
    sees, one as probable as the other; NaN of other markers.
    """

    markers: Sequence[Marker]
    position: Array
    covariance: Array
    velocity: Array
    normal: Array
    candidates: Array

    def joined(self, other: "UnlabeledMarkers") -> "UnlabeledMarkers":
        """Both."""
        names = "position", "covariance", "velocity", "normal", "candidates"
        columns = {name: np.concatenate([getattr(self, name), getattr(other, name)]) for name in names}
        return UnlabeledMarkers((*self.markers, *other.markers), **columns)


NO_ROWS, NO_PAIRS = np.empty((0, 3)), np.empty((0, 2, 3))
NONE = UnlabeledMarkers((), NO_ROWS, np.empty((0, 3, 3)), NO_ROWS, NO_ROWS, NO_PAIRS)


@dataclass(frozen=True, slots=True, eq=False)
class _Tracks:
    """K markers: where they are, the radius (K,) that they are taken to have, whether their normal was clear."""

    states: States
    radius: Array
    clear: Mask
    seen_ns: NDArray[np.int64]

    def select(self, rows: NDArray) -> "_Tracks":
        return _Tracks(self.states.select(rows), self.radius[rows], self.clear[rows], self.seen_ns[rows])

    def joined(self, other: "_Tracks") -> "_Tracks":
        states = States(
            *(np.concatenate([getattr(s, k) for s in (self.states, other.states)]) for k in States.__slots__)
        )
        rest = ((getattr(self, k), getattr(other, k)) for k in ("radius", "clear", "seen_ns"))
        return _Tracks(states, *(np.concatenate(pair) for pair in rest))


class UnlabeledTracker:
    """Follows a rig's loose markers.

    Args:
        optics: the cameras.
        radii: (R,) of the markers in use, one or more.
    """

    def __init__(self, optics: CameraArray, radii: Array) -> None:
        self._optics, self._radii, self._t_ns = optics, np.unique(radii), 0
        self._tracks = self._born([], np.empty((0, 3)), [], 0)

    def follow(self, t_ns: int, sightings: DetectionTable, markers: Sequence[Marker]) -> UnlabeledMarkers:
        """The markers of an instant, followed from the last."""
        if not markers and not len(self._tracks.radius):
            return NONE
        there = np.array([marker.position for marker in markers]).reshape(-1, 3)
        spread = np.array([marker.covariance for marker in markers]).reshape(-1, 3, 3)
        tracks = self._predicted(t_ns)
        track = _pair(tracks.states, there, spread)
        kept, new = np.flatnonzero(track >= 0), np.flatnonzero(track < 0)
        fresh = [markers[k] for k in new.tolist()]
        normals = [self._normal(sightings, marker) for marker in fresh]
        born = self._born(fresh, there[new], normals, t_ns)
        mine = tracks.select(track[kept]).joined(born).select(np.argsort(np.concatenate([kept, new])))
        states, good = self._updated(mine, sightings, markers)
        mine = _Tracks(states, mine.radius, mine.clear, np.full(len(states), t_ns))
        unseen = np.setdiff1d(np.arange(len(tracks.radius)), track)
        self._tracks, self._t_ns = tracks.select(unseen).joined(mine.select(good)), t_ns
        return _told(markers, mine, good, there, spread)

    def _predicted(self, t_ns: int) -> _Tracks:
        """Those seen a short time ago, where they should be now."""
        tracks = self._tracks.select((t_ns - self._tracks.seen_ns) * 1e-9 < FORGOTTEN_S)
        dt = np.full(len(tracks.radius), max((t_ns - self._t_ns) * 1e-9, 0.0))
        states = self._estimator(len(dt)).predict(tracks.states, dt).states
        return _Tracks(states, tracks.radius, tracks.clear, tracks.seen_ns)

    def _born(self, markers: list[Marker], at: Array, normals: list[Array | None], t_ns: int) -> _Tracks:
        facing = [self._towards(m) if n is None else n for m, n in zip(markers, normals, strict=True)]
        R = np.array([rotation_to(normal) for normal in facing]).reshape(-1, 3, 3)
        states = States.at_rest(R, at, BIRTH)
        states.P[:] = forget_turn(states.P)
        radius = np.array([self._radius(marker) for marker in markers])
        clear = np.array([normal is not None for normal in normals], bool)
        return _Tracks(states, radius, clear, np.full(len(markers), t_ns))

    def _updated(
        self, tracks: _Tracks, sightings: DetectionTable, markers: Sequence[Marker]
    ) -> tuple[States, Mask]:
        """Where the markers are by their own detections, and which of them these agree with."""
        n = len(markers)
        if not n:
            return tracks.states, np.zeros(0, bool)
        rows = np.concatenate([marker.sightings for marker in markers])
        body = np.repeat(np.arange(n), [len(marker.sightings) for marker in markers])
        centres = np.zeros((3, len(rows)))
        discs = Discs(sightings.frame[rows], body, body, centres, tracks.radius[body])
        observations = MatchedObservations.seeing(sightings.select(rows), discs)
        still = Transition(np.zeros((n, 3, 3)), np.zeros(n))
        prediction = Prediction(tracks.states, _core.inverses(tracks.states.P), still)
        states, rest = self._estimator(n).update(prediction, observations)
        return states, mean_of_bodies(misfit(observations, rest, SLACK_PX), body, n) < MAX_CHI2

    def _estimator(self, n: int) -> Estimator:
        return Estimator(self._optics, np.tile(MOTIONS["aerial"].densities, (n, 1)), np.ones(n, bool))

    def _radius(self, marker: Marker) -> float:
        """The one in use that is nearest to how large the marker looks."""
        if not np.isfinite(marker.diameter_m):
            return float(self._radii[0])
        return float(self._radii[np.argmin(np.abs(self._radii - marker.diameter_m / 2))])

    def _normal(self, sightings: DetectionTable, marker: Marker) -> Array | None:
        return find_normal(self._optics, sightings, marker, self._radius(marker))

    def _towards(self, marker: Marker) -> Array:
        to = self._optics.centres[np.unique(marker.cameras)] - marker.position
        mean = (to / np.linalg.norm(to, axis=1, keepdims=True)).sum(0)
        return mean / np.linalg.norm(mean)


def _pair(states: States, there: Array, spread: Array) -> Index:
    """(M,) the track of each marker, where both are nearest to each other and within reach; else -1."""
    if not len(states) or not len(there):
        return np.full(len(there), -1)
    off = there[:, None] - states.p
    S = spread[:, None] + states.P[:, POSITION, POSITION]
    d2 = np.einsum("mki,mki->mk", off, np.linalg.solve(S, off[..., None])[..., 0])
    track = d2.argmin(1)
    mutual = d2.argmin(0)[track] == np.arange(len(there))
    return np.where(mutual & (d2.min(1) < REACH), track, -1)


def _told(
    markers: Sequence[Marker], tracks: _Tracks, good: Mask, there: Array, spread: Array
) -> UnlabeledMarkers:
    """Of the markers that are followed what that tells, of the others where they were grouped."""
    states, known = tracks.states, good[:, None]
    tilt2 = np.einsum("nii->n", states.P[:, :2, :2]) / 2
    faces = good & tracks.clear & (tilt2 < NORMAL_RAD**2)
    return UnlabeledMarkers(
        markers,
        np.where(known, states.p, there),
        np.where(known[:, None], states.P[:, POSITION, POSITION], spread),
        np.where(known, states.v, np.nan),
        np.where(faces[:, None], states.R[:, :, 2], np.nan),
        np.full((len(markers), 2, 3), np.nan),
    )
