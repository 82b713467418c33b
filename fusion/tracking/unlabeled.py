# SPDX-License-Identifier: BSD-3-Clause
"""Tracks unlabeled markers from frame set to frame set, each as a nameless robot with a single marker.

Grouping triangulates a marker from rays of different times, with a covariance for any speed up to `MAX_SPEED_M_S`.
The estimator for robots then estimates velocity and normal with the position.

Markers belong to one body if their distance stays the same while they move (`CommonMotion`).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from camera_node.foundation.arrays import Array, Index, Mask
from fusion.model.likeness import distances
from fusion.model.observations import CameraArray, DetectionTable, Discs, MatchedObservations, mean_by_body
from fusion.model.robots import MOTIONS
from fusion.model.states import POSITION, States, reset_unobservable
from fusion.tracking.estimator import Estimator, Prediction
from fusion.tracking.gating import (
    ANY_DIAMETERS,
    DIAMETER_TOLERANCE,
    FORGET_NS,
    MAX_CHI2,
    POSITION_GATE,
    START_SIGMAS_SINGLE,
)
from fusion.tracking.normals import start_rotation
from fusion.tracking.rays import Marker, MarkerHistories

MOVED_M = 0.05  # since the anchor: far above the noise
CONCLUSIVE_M = (
    0.15  # two markers that moved so far together belong to one body, also after one of them is hidden
)
RIGID_M = 0.01  # largest change of the distance of two markers of one body
BODY_M = 1.0  # largest distance of two markers of one body


@dataclass(frozen=True, slots=True, eq=False)
class CommonMotion:
    """What the motion of K markers says about the bodies that they belong to.

    Positions are compared with anchors, positions of one time not long ago. Each frame set that sees both markers of a
    pair, one of which has moved, votes for or against one body: at single times, the distance of two robots that pass
    each other is the same as at the anchor.

    Attributes:
        anchor: (K, 3) NaN for markers that are younger.
        votes: (K, K) for one body less those against it, since the anchor.
        rigid_m: (K, K) how far a pair has moved as one body, 0 as soon as the votes contradict it.
        belonged: (K,) to a body whose other marker was lost from view.
        moved: (K,) since the anchor, as of the last observation.
    """

    anchor: Array
    votes: NDArray[np.int64]
    rigid_m: Array
    belonged: Mask
    moved: Mask

    @classmethod
    def unknown(cls, n: int) -> "CommonMotion":
        """Of n new markers."""
        pairs, never = np.zeros((n, n)), np.zeros(n, bool)
        return cls(np.full((n, 3), np.nan), pairs.astype(np.int64), pairs, never, never)

    @property
    def anchored(self) -> Mask:
        """(K,) whose motion can be compared."""
        return np.isfinite(self.anchor[:, 0])

    @property
    def moves_with_others(self) -> Mask:
        """(K,) markers that moved together with another one."""
        return self.belonged | (self.rigid_m > 0).any(1)

    @property
    def alone(self) -> Mask:
        """(K,) markers that moved, none of the others with them."""
        return self.moved & ~self.moves_with_others

    def select(self, rows: NDArray) -> "CommonMotion":
        """Of some of the markers, indices; the bodies of the others are remembered."""
        gone = np.ones(len(self.anchor), bool)
        gone[rows] = False
        belonged = self.belonged | (self.rigid_m[:, gone] > CONCLUSIVE_M).any(1)
        pairs = np.ix_(rows, rows)
        return CommonMotion(
            self.anchor[rows], self.votes[pairs], self.rigid_m[pairs], belonged[rows], self.moved[rows]
        )

    def with_new(self, n: int) -> "CommonMotion":
        """Of these markers, then n new ones."""
        new = CommonMotion.unknown(n)
        return CommonMotion(
            np.concatenate([self.anchor, new.anchor]),
            np.pad(self.votes, (0, n)),
            np.pad(self.rigid_m, (0, n)),
            np.concatenate([self.belonged, new.belonged]),
            np.concatenate([self.moved, new.moved]),
        )

    def observed(self, p: Array, radius: Array, seen: Mask) -> "CommonMotion":
        """With the votes of a frame set.

        Args:
            p: (K, 3) positions, world frame, m.
            radius: (K,) of the markers, m. Two that overlap are one disc that was triangulated twice.
            seen: (K,) in this frame set.
        """
        motion = np.nan_to_num(np.linalg.norm(p - self.anchor, axis=1))
        moved = seen & (motion > MOVED_M)
        if not moved.any():
            return replace(self, moved=moved)
        now = distances(p)
        overlap = now < radius[:, None] + radius
        known = seen & self.anchored
        compared = known[:, None] & known & (moved[:, None] | moved) & ~overlap
        is_rigid = (np.abs(now - distances(self.anchor)) < RIGID_M) & (now < BODY_M)
        votes = self.votes + np.where(compared, np.where(is_rigid, 1, -1), 0)
        pair_m = np.maximum(self.rigid_m, np.maximum(motion[:, None], motion))
        rigid_m = np.where(compared & (votes > 0), pair_m, np.where(votes < 0, 0.0, self.rigid_m))
        return replace(self, votes=votes, rigid_m=rigid_m, moved=moved)

    def anchored_at(self, p: Array) -> "CommonMotion":
        """With new anchors, the positions p (K, 3)."""
        return replace(self, anchor=p, votes=np.zeros_like(self.votes), moved=np.zeros(len(p), bool))


MAX_TRACKS = 64  # markers with a velocity and a normal; false detections make hundreds of markers
MAX_STARTS = 8  # tracks that begin in one frame set; a start costs a millisecond
NORMAL_RAD = 0.2  # largest standard deviation of a published normal
ANCHOR_NS = 1_000_000_000  # motions are compared over this time


@dataclass(frozen=True, slots=True, eq=False)
class UnlabeledMarkers:
    """The N unlabeled markers of a frame set.

    Attributes:
        markers: their detections.
        position, covariance: (N, 3) and (N, 3, 3), world frame.
        velocity, normal: (N, 3), world frame; NaN where unknown.
        candidates: (N, 2, 3) the two equally probable normals of a marker that one camera sees; NaN for others.
    """

    markers: Sequence[Marker]
    position: Array
    covariance: Array
    velocity: Array
    normal: Array
    candidates: Array

    @classmethod
    def none(cls) -> "UnlabeledMarkers":
        """No marker."""
        rows = np.empty((0, 3))
        return cls((), rows, np.empty((0, 3, 3)), rows, rows, np.empty((0, 2, 3)))

    @property
    def detections(self) -> Index:
        """Rows of all their detections."""
        return np.concatenate([np.empty(0, np.intp), *(marker.detections for marker in self.markers)])

    def joined(self, other: "UnlabeledMarkers") -> "UnlabeledMarkers":
        """These markers, then the others."""
        names = "position", "covariance", "velocity", "normal", "candidates"
        columns = {name: np.concatenate([getattr(self, name), getattr(other, name)]) for name in names}
        return UnlabeledMarkers((*self.markers, *other.markers), **columns)


@dataclass(frozen=True, slots=True, eq=False)
class _Tracks:
    """K markers.

    Attributes:
        states: the last ones.
        radius: (K,) the assumed one.
        has_normal: (K,) whether the normal was determined.
        seen_ns, since_ns: (K,) times of the last and the first detection.
        company: which of them belong to one body.
    """

    states: States
    radius: Array
    has_normal: Mask
    seen_ns: NDArray[np.int64]
    since_ns: NDArray[np.int64]
    company: CommonMotion

    def __len__(self) -> int:
        return len(self.states)

    def select(self, rows: NDArray) -> "_Tracks":
        return _Tracks(
            self.states.select(rows),
            self.radius[rows],
            self.has_normal[rows],
            self.seen_ns[rows],
            self.since_ns[rows],
            self.company.select(rows),
        )

    def with_new(self, states: States, radius: Array, has_normal: Mask, t_ns: int) -> "_Tracks":
        """These tracks, then new ones."""
        times = np.full(len(states), t_ns, np.int64)
        return _Tracks(
            self.states.joined(states),
            np.concatenate([self.radius, radius]),
            np.concatenate([self.has_normal, has_normal]),
            np.concatenate([self.seen_ns, times]),
            np.concatenate([self.since_ns, times]),
            self.company.with_new(len(states)),
        )

    @classmethod
    def none(cls) -> "_Tracks":
        states = States.at_rest(np.empty((0, 3, 3)), np.empty((0, 3)), START_SIGMAS_SINGLE)
        times = np.empty(0, np.int64)
        return cls(states, np.empty(0), np.empty(0, bool), times, times, CommonMotion.unknown(0))

    def updated(self, rows: Index, states: States, t_ns: int) -> "_Tracks":
        """With new states of the tracks that were seen."""
        seen_ns = self.seen_ns.copy()
        seen_ns[rows] = t_ns
        return replace(self, states=self.states.with_rows(rows, states), seen_ns=seen_ns)

    def compared(self, t_ns: int, is_due: bool) -> "_Tracks":
        """With what the motion until now shows; with new anchors if these are due."""
        company = self.company.observed(self.states.p, self.radius, self.seen_ns == t_ns)
        return replace(self, company=company.anchored_at(self.states.p) if is_due else company)


class UnlabeledTracker:
    """Tracks the unlabeled markers of a rig.

    Args:
        cameras: cameras of the rig.
        radii: (R,) of the markers in use; a marker of another size has its apparent one.
    """

    def __init__(self, cameras: CameraArray, radii: Array) -> None:
        self._cameras, self._radii, self._t_ns = cameras, np.unique(radii), 0
        self._tracks = _Tracks.none()
        self._anchored_ns = 0

    def track(self, t_ns: int, detections: DetectionTable, markers: Sequence[Marker]) -> UnlabeledMarkers:
        """Continue tracks with the markers that grouping found, and start tracks for others.

        At most `MAX_TRACKS` markers have a track, of which `MAX_STARTS` begin in one frame set; the others are reported
        as triangulated.
        """
        if not markers and not len(self._tracks):
            return UnlabeledMarkers.none()
        position = np.array([marker.position for marker in markers]).reshape(-1, 3)
        covariance = np.array([marker.covariance for marker in markers]).reshape(-1, 3, 3)
        tracks = self._predict(t_ns)
        pair = _pair(tracks.states, position, covariance)
        old = np.flatnonzero(pair >= 0)
        new = np.flatnonzero(pair < 0)[: min(MAX_STARTS, MAX_TRACKS - len(tracks))]
        seen = np.concatenate([pair[old], len(tracks) + np.arange(len(new))])
        rows = np.concatenate([old, new])
        tracks = tracks.with_new(*self._start(detections, [markers[k] for k in new.tolist()]), t_ns)
        states, good = self._update(tracks, seen, detections, [markers[k] for k in rows.tolist()])
        tracks = tracks.updated(seen, states, t_ns)
        current = tracks.select(seen[good])
        is_due = not 0 <= t_ns - self._anchored_ns < ANCHOR_NS
        self._anchored_ns = t_ns if is_due else self._anchored_ns
        remaining = np.setdiff1d(np.arange(len(tracks)), seen[~good])
        self._tracks = tracks.select(remaining).compared(t_ns, is_due)
        self._t_ns = t_ns
        grouped = UnlabeledMarkers(markers, position, covariance, *_unknown(len(markers)))
        return _with_tracks(grouped, rows[good], current)

    def histories(self, t_ns: int, markers: Sequence[Marker]) -> MarkerHistories:
        """The histories of markers of the present frame set, before `track` continues them."""
        tracks = self._predict(t_ns)
        position = np.array([marker.position for marker in markers]).reshape(-1, 3)
        covariance = np.array([marker.covariance for marker in markers]).reshape(-1, 3, 3)
        pair = _pair(tracks.states, position, covariance)
        paired, known = np.flatnonzero(pair >= 0), pair[pair >= 0]
        age_s, (anchored, moves_with_others, alone) = np.zeros(len(pair)), np.zeros((3, len(pair)), bool)
        age_s[paired] = (t_ns - tracks.since_ns[known]) * 1e-9
        company = tracks.company
        anchored[paired], moves_with_others[paired] = (
            company.anchored[known],
            company.moves_with_others[known],
        )
        alone[paired] = company.alone[known]
        return MarkerHistories(age_s, anchored, moves_with_others, alone)

    def _predict(self, t_ns: int) -> _Tracks:
        tracks = self._tracks.select(t_ns - self._tracks.seen_ns < FORGET_NS)
        dt = np.full(len(tracks), max((t_ns - self._t_ns) * 1e-9, 0.0))
        states = self._estimator(len(dt)).predict(tracks.states, dt).states
        return replace(tracks, states=states)

    def _start(self, detections: DetectionTable, markers: list[Marker]) -> tuple[States, Array, Mask]:
        """States and radii of new tracks, and which of their normals are determined."""
        radius = np.array([self._radius(marker) for marker in markers])
        starts = [
            start_rotation(self._cameras, detections, marker, r)
            for marker, r in zip(markers, radius.tolist(), strict=True)
        ]
        R = np.array([R for R, _ in starts]).reshape(-1, 3, 3)
        p = np.array([marker.position for marker in markers]).reshape(-1, 3)
        states = States.at_rest(R, p, START_SIGMAS_SINGLE)
        states.P[:] = reset_unobservable(states.P)
        has_normal = np.array([determined for _, determined in starts], bool)
        return states, radius, has_normal

    def _update(
        self, tracks: _Tracks, seen: Index, detections: DetectionTable, markers: Sequence[Marker]
    ) -> tuple[States, Mask]:
        """Update the tracks `seen` with the detections of their markers; and which of them fit these."""
        n, before = len(markers), tracks.states.select(seen)
        if not n:
            return before, np.zeros(0, bool)
        rows = np.concatenate([marker.detections for marker in markers])
        body = np.repeat(np.arange(n), [len(marker.detections) for marker in markers])
        centres, up = np.zeros((3, len(rows))), np.tile([[0.0], [0.0], [1.0]], len(rows))
        discs = Discs(detections.frame[rows], body, body, centres, up, tracks.radius[seen][body])
        observations = MatchedObservations.of_discs(detections.select(rows), discs)
        states, squared_px = self._estimator(n).update(Prediction.without_motion(before), observations)
        return states, mean_by_body(observations.misfit(squared_px), body, n) < MAX_CHI2

    def _estimator(self, n: int) -> Estimator:
        return Estimator(self._cameras, np.tile(MOTIONS["aerial"].densities, (n, 1)), np.ones(n, bool))

    def _radius(self, marker: Marker) -> float:
        """The radius in use that is closest to the apparent size of the marker; the apparent one if none is near."""
        apparent = marker.diameter_m / 2
        if not np.isfinite(apparent):
            return float(self._radii[0]) if len(self._radii) else ANY_DIAMETERS[0] / 2
        off = np.abs(self._radii / apparent - 1)
        if not len(off) or off.min() > DIAMETER_TOLERANCE:
            return apparent
        return float(self._radii[np.argmin(off)])


def _pair(states: States, position: Array, covariance: Array) -> Index:
    """(M,) the track of each marker if both are closest to each other and within the gate, else -1."""
    if not len(states) or not len(position):
        return np.full(len(position), -1)
    off, own = position[:, None] - states.p, states.P[:, POSITION, POSITION]
    spread = np.einsum("mii->m", covariance)[:, None] + np.einsum("kii->k", own)
    m, k = np.nonzero(np.einsum("mki,mki->mk", off, off) < POSITION_GATE * spread)  # necessary for the gate
    d2 = np.full(off.shape[:2], np.inf)
    e = off[m, k]
    d2[m, k] = np.einsum("pi,pi->p", e, np.linalg.solve(covariance[m] + own[k], e[:, :, None])[:, :, 0])
    track = d2.argmin(1)
    mutual = d2.argmin(0)[track] == np.arange(len(position))
    return np.where(mutual & (d2.min(1) < POSITION_GATE), track, -1)


def _unknown(n: int) -> tuple[Array, Array, Array]:
    """Velocities, normals and candidates of n markers without any."""
    return np.full((n, 3), np.nan), np.full((n, 3), np.nan), np.full((n, 2, 3), np.nan)


def _with_tracks(grouped: UnlabeledMarkers, rows: Index, tracks: _Tracks) -> UnlabeledMarkers:
    """The markers, those of `rows` with the estimates of their tracks in place of the triangulated positions."""
    states = tracks.states
    tilt2 = np.einsum("nii->n", states.P[:, :2, :2]) / 2
    has_normal = tracks.has_normal & (tilt2 < NORMAL_RAD**2)
    columns = {
        name: getattr(grouped, name).copy() for name in ("position", "covariance", "velocity", "normal")
    }
    columns["position"][rows], columns["velocity"][rows] = states.p, states.v
    columns["covariance"][rows] = states.P[:, POSITION, POSITION]
    columns["normal"][rows[has_normal]] = states.R[has_normal, :, 2]
    return replace(grouped, **columns)
