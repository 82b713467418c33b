# SPDX-License-Identifier: BSD-3-Clause
"""Finds an object of known size among the unlabeled markers of a running or recorded arena.

Markers are linked from frame set to frame set. Two markers belong to the object if both move, their distance stays the
same, and it is a declared one. A roundel of the background stands still, so it is never taken for one of the object.
"""

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from calib.rig.wand_file import WandBody
from camera_node.foundation.arrays import Array, Index, Mask
from camera_node.foundation.errors import ConfigError
from fusion.model.likeness import distances
from fusion.model.robots import MAX_MARKERS
from fusion.protocol.pose_messages import Markers
from fusion.tracking.gating import DIAMETER_TOLERANCE

MAX_FRAME_SETS = 60_000  # ten minutes at 100 Hz
MAX_CANDIDATES = 64  # markers of one frame set: as many as the server tracks
MAX_SCALE_ERROR = 0.05  # of a calibration: objects whose lengths differ by less can be confused
GAP_S = 0.5  # a marker that was not seen for longer is another one
LINK_M = 0.03  # 1 g during a twentieth of a second moves it 12 mm away from its prediction
RIGID_M = 0.01  # largest change of the distance of two markers of one body
RIGID_SHARE = 0.9  # of the frame sets that see both
MIN_TOGETHER = 5  # frame sets that see both
MOVED_M = 0.05  # far above the noise
SIGMAS = 3.0
SEEDS = 50  # pairs of markers from which a labeling starts
CLEARER = 2.0  # ratio of misfits of two labelings, beyond which the better one is right
MISFIT = 1e-3  # relative, of lengths whose noise is small

Labels = tuple[tuple[int, int], ...]  # number of the track and of the object's marker, by track


@dataclass(frozen=True, slots=True, eq=False)
class ObjectCandidates:
    """The markers of a frame set that may be the object's.

    Attributes:
        t_ns: its time.
        track: (N,) numbers that stay the same from frame set to frame set.
        position, covariance: (N, 3) and (N, 3, 3), world, metres.
        cameras: (N, C) which cameras saw each.
    """

    t_ns: int
    track: Index
    position: Array
    covariance: Array
    cameras: Mask


@dataclass(frozen=True, slots=True, eq=False)
class Sighting:
    """K >= 2 markers of the object in one frame set: the rows of its file, and columns as in `ObjectCandidates`."""

    t_ns: int
    marker: Index
    position: Array
    covariance: Array
    cameras: Mask


@dataclass(slots=True)
class _Pair:
    """The distance of two tracks: frame sets that saw both, those that saw the mean distance, and that, metres."""

    seen: int = 0
    equal: int = 0
    mean_m: float = 0.0

    def add(self, distance_m: float, sigma_m: float) -> None:
        self.seen += 1
        self.mean_m += (distance_m - self.mean_m) / self.seen
        self.equal += abs(distance_m - self.mean_m) < RIGID_M + SIGMAS * sigma_m

    @property
    def is_rigid(self) -> bool:
        return self.seen >= MIN_TOGETHER and self.equal >= RIGID_SHARE * self.seen


class ObjectFinder:
    """Collects markers, then finds the object in each frame set.

    Args:
        body: the object; it needs two markers.
        cameras: names of the placed cameras.

    Attributes:
        unused: frame sets and markers that were not used, by the reason.

    Raises:
        ConfigError: the object has too few or too many markers.
    """

    def __init__(self, body: WandBody, cameras: Sequence[str]) -> None:
        if not 2 <= len(body.markers) <= MAX_MARKERS:
            raise ConfigError(
                f"the object has {len(body.markers)} markers; it needs 2 to {MAX_MARKERS}, a known distance apart"
            )
        self.unused: Counter[str] = Counter()
        self._body, self._cameras = body, list(cameras)
        self._lengths = distances(body.points)
        self._frame_sets: list[ObjectCandidates] = []
        self._velocity, self._n_tracks = np.empty((0, 3)), 0
        self._pairs: dict[tuple[int, int], _Pair] = {}
        self._extent: dict[int, Array] = {}  # (2, 3) lowest and highest coordinates of a track

    def add(self, message: Markers) -> None:
        """Take the unlabeled markers of a frame set whose size fits; later ones than before."""
        last = self._frame_sets[-1] if self._frame_sets else None
        if last is not None and message.t_ns <= last.t_ns:
            self.unused["frame sets out of order"] += 1
        elif len(self._frame_sets) >= MAX_FRAME_SETS:
            self.unused[f"frame sets beyond {MAX_FRAME_SETS}"] += 1
        else:
            self._count_labeled(message)
            rows = self._plausible(message)
            candidates = self._link(message, rows, last)
            self._frame_sets.append(candidates)
            self._velocity = np.nan_to_num(message.velocities()[rows].astype(float))
            self._note_motion(candidates)

    @property
    def frame_sets(self) -> int:
        """Number of the frame sets so far."""
        return len(self._frame_sets)

    def sightings(self) -> list[Sighting]:
        """The frame sets that show two or more markers of the object, and leave no doubt which ones."""
        fits = self._fits()
        partners = {track for pair in fits for track in pair}
        known: dict[tuple[int, ...], Labels | None] = {}
        found = []
        for candidates in self._frame_sets:
            present = tuple(sorted(partners.intersection(candidates.track.tolist())))
            if present not in known:
                known[present] = self._label(present, fits)
            labels = known[present]
            if labels is None:
                self.unused["frame sets that several labelings explain"] += 1
            elif not labels:
                self.unused["frame sets without two markers of the object"] += 1
            else:
                rows = np.array([candidates.track.tolist().index(track) for track, _ in labels])
                columns = candidates.position[rows], candidates.covariance[rows], candidates.cameras[rows]
                found.append(Sighting(candidates.t_ns, np.array([m for _, m in labels]), *columns))
        return found

    def _count_labeled(self, message: Markers) -> None:
        for robot in set(message.robot_index().tolist()) - {-1}:
            self.unused[f"frame sets with markers that are labeled as robot '{message.robots[robot]}'"] += 1

    def _plausible(self, message: Markers) -> Index:
        """Rows of the unlabeled markers that two cameras see, whose size fits and whose claim is a covariance."""
        rows = message.unlabeled()
        if self._body.diameter_m:
            ratio = message.diameters()[rows] / self._body.diameter_m
            rows = rows[~(np.abs(ratio - 1) > DIAMETER_TOLERANCE)]  # NaN: of unknown size
        claims = np.frombuffer(message.covariance, "<f4").reshape(-1, 3, 3)[rows].astype(float)
        finite = np.asarray(np.isfinite(claims).all(axis=(1, 2)))
        smallest = np.linalg.eigvalsh(np.where(finite[:, None, None], claims, 0.0))[:, 0]
        valid = finite & (smallest > 0)
        self.unused["markers without a valid covariance"] += int((~valid).sum())
        if (excess := int(valid.sum()) - MAX_CANDIDATES) > 0:
            self.unused[f"markers beyond {MAX_CANDIDATES} of the object's size in one frame set"] += excess
        return np.asarray(rows[valid][:MAX_CANDIDATES], np.intp)

    def _link(self, message: Markers, rows: Index, last: ObjectCandidates | None) -> ObjectCandidates:
        """The markers `rows`, with the numbers of the tracks that they continue, or new ones."""
        position = message.positions()[rows].astype(float)
        track = np.full(len(rows), -1)
        if last is not None and len(last.track) and len(rows):
            dt = (message.t_ns - last.t_ns) * 1e-9
            if dt < GAP_S:
                d = np.linalg.norm(position[:, None] - (last.position + self._velocity * dt), axis=2)
                nearest = d.argmin(axis=1)
                mutual = d.argmin(axis=0)[nearest] == np.arange(len(rows))
                track = np.where(mutual & (d.min(axis=1) < LINK_M), last.track[nearest], -1)
        new = track < 0
        track[new] = self._n_tracks + np.arange(new.sum())
        self._n_tracks += int(new.sum())
        covariance = np.frombuffer(message.covariance, "<f4").reshape(-1, 3, 3)[rows].astype(float)
        bits = message.camera_bits()[rows]
        seen = np.zeros((len(rows), len(self._cameras)), bool)
        for k, name in enumerate(message.camera_names):
            if name in self._cameras:
                seen[:, self._cameras.index(name)] = (bits >> np.uint64(k)) & np.uint64(1) > 0
        return ObjectCandidates(message.t_ns, track, position, covariance, seen)

    def _note_motion(self, candidates: ObjectCandidates) -> None:
        """Note how far each track has moved, and the distances of pairs that may be the object's."""
        p, tracks = candidates.position, candidates.track.tolist()
        for track, place in zip(tracks, p, strict=True):
            low, high = self._extent.get(track, (place, place))
            self._extent[track] = np.array([np.minimum(low, place), np.maximum(high, place)])
        now = distances(p)
        sigma = np.sqrt(np.einsum("nii->n", candidates.covariance))
        longest = self._lengths.max() * (1 + MAX_SCALE_ERROR)
        for a, b in combinations(range(len(tracks)), 2):
            sigma_m = float(np.hypot(sigma[a], sigma[b]))
            pair = min(tracks[a], tracks[b]), max(tracks[a], tracks[b])
            if pair in self._pairs or now[a, b] < longest + SIGMAS * sigma_m:
                self._pairs.setdefault(pair, _Pair()).add(float(now[a, b]), sigma_m)

    def _fits(self) -> dict[tuple[int, int], Mask]:
        """(M, M) the declared lengths that each pair of tracks may be, for pairs that move and are rigid."""
        moved = {track for track, (low, high) in self._extent.items() if np.linalg.norm(high - low) > MOVED_M}
        fits = {}
        for pair, distance in self._pairs.items():
            if distance.is_rigid and moved.issuperset(pair):
                fit = np.abs(distance.mean_m - self._lengths) < MAX_SCALE_ERROR * self._lengths
                if fit.any():
                    fits[pair] = fit
        return fits

    def _label(self, tracks: tuple[int, ...], fits: dict[tuple[int, int], Mask]) -> Labels | None:
        """The labels of most of the tracks; none without two of them, None where another labeling fits as well."""
        pairs = [pair for pair in combinations(tracks, 2) if pair in fits]
        pairs.sort(key=lambda pair: -self._pairs[pair].mean_m)
        largest: set[Labels] = set()
        for a, b in pairs[:SEEDS]:
            for i, j in np.argwhere(fits[a, b]).tolist():
                labels = self._extend({a: i, b: j}, tracks, fits)
                size = max((len(found) for found in largest), default=0)
                if len(labels) >= size:
                    largest = {labels} | (largest if len(labels) == size else set())
        if not largest:
            return ()
        if len({tuple(track for track, _ in labels) for labels in largest}) > 1:
            return None
        misfit, best = min((self._misfit(labels), labels) for labels in largest)
        others = (labels for labels in largest if not self._has_lengths_of(labels, best))
        is_clear = all(self._misfit(labels) > CLEARER * misfit + MISFIT for labels in others)
        return best if is_clear else None

    def _extend(
        self, labels: dict[int, int], tracks: Iterable[int], fits: dict[tuple[int, int], Mask]
    ) -> Labels:
        """Label further tracks, each by the marker whose lengths to the labeled ones fit best."""
        for track in tracks:
            if track in labels:
                continue
            known = [(min(track, other), max(track, other)) for other in labels]
            if not all(pair in fits for pair in known):
                continue
            numbers = list(labels.values())
            possible = [
                (self._misfit(tuple(sorted({**labels, track: m}.items()))), m)
                for m in range(len(self._lengths))
                if m not in numbers and all(fits[pair][m, n] for pair, n in zip(known, numbers, strict=True))
            ]
            if possible:
                labels = {**labels, track: min(possible)[1]}
        return tuple(sorted(labels.items()))

    def _ratios(self, labels: Labels) -> Array:
        """Measured over declared lengths of all pairs."""
        return np.array(
            [self._pairs[a, b].mean_m / self._lengths[i, j] for (a, i), (b, j) in combinations(labels, 2)]
        )

    def _misfit(self, labels: Labels) -> float:
        """Relative differences of the lengths, beyond a common scale."""
        return float(self._ratios(labels).std())

    def _has_lengths_of(self, labels: Labels, other: Labels) -> bool:
        """Whether two labelings of the same tracks declare the same lengths."""
        return np.allclose(self._ratios(labels), self._ratios(other), rtol=1e-6)
