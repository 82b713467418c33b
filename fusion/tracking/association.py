# SPDX-License-Identifier: BSD-3-Clause
"""Which detection is of which marker, while robots are tracked.

Each marker is predicted into each frame at the frame's own time; within a gate of its covariance and apparent size,
detections are assigned globally, frame by frame: no detection is of two markers. The cost of a pair is its negative
log-likelihood (Bar-Shalom et al. 2001, section 6.4), so that a vague prediction does not take what an exact one fits:
`native/candidates.cpp` finds the pairs and their costs.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import linear_sum_assignment

from camera_node.arrays import Array, Index, Mask
from fusion import _core
from fusion.model.camera_array import CameraArray
from fusion.model.frames import CalibratedFrame, FrameSet
from fusion.model.observations import Assignments, DetectionTable, MarkerTable
from fusion.model.states import States

UNMATCHED = 1e4  # the cost of leaving a marker unseen: more than any sum of costs within gates
MOST = 1 << 32  # detections: more than any frame has
TOGETHER = 150  # contested pairs that are assigned in one go, frames and all


@dataclass(frozen=True, slots=True, eq=False)
class _Part:
    """Frames that were matched at once: of each match the row of its frame, that of the detection there, the disc."""

    frames: tuple[CalibratedFrame, ...]
    frame: Index
    row: Index
    disc: Index

    def rows(self, first: dict[int, int]) -> Index:
        """The detections' rows in an instant whose frames begin at `first`, by id(); below 0 of frames not in it."""
        begin = np.array([first.get(id(frame), -MOST) for frame in self.frames], np.intp)
        return begin[self.frame] + self.row


class Association:
    """An instant's detections matched to robots, as many frames at a time as there are.

    Args:
        optics: the cameras.
        catalogue: the robots' markers.
        states: the robots as predicted at `t_ns`.
        active: (N,) those whose markers are looked for.
        t_ns: the instant.
        floor_px: see `DetectionTable.of`.
    """

    def __init__(
        self,
        optics: CameraArray,
        catalogue: MarkerTable,
        states: States,
        active: Mask,
        t_ns: int,
        floor_px: float,
    ) -> None:
        self._optics, self._catalogue, self._states = optics, catalogue, states
        self._markers = np.flatnonzero(active[catalogue.robot])
        discs = catalogue.robot[self._markers], catalogue.marker.take(self._markers, 1)
        self._expected = _core.ExpectedMarkers(states.R, states.P, *discs, catalogue.radius[self._markers])
        self._t_ns, self._floor_px = t_ns, floor_px
        self._parts: list[_Part] = []
        self._done: set[int] = set()  # the frames' id(): what is in a part lives on

    def missing(self, frames: Sequence[CalibratedFrame]) -> tuple[CalibratedFrame, ...]:
        """Those of the frames that are not matched yet."""
        return tuple(frame for frame in frames if id(frame) not in self._done)

    def add(self, frames: Sequence[CalibratedFrame]) -> None:
        """Match those of the frames that are not matched yet, all at once."""
        new = self.missing(frames)
        if new:
            sightings = DetectionTable.of(FrameSet(self._t_ns, new), self._optics, self._floor_px)
            sighting, disc = self._match(sightings)
            frame = sightings.frame[sighting]
            self._parts.append(_Part(new, frame, sighting - _first_rows(new)[frame], disc))
            self._done.update(map(id, new))

    def whole(self, instant: FrameSet) -> tuple[DetectionTable, Assignments]:
        """All detections of the instant, and what they are matched to, in order of the detections."""
        self.add(instant.frames)
        sightings = DetectionTable.of(instant, self._optics, self._floor_px)
        first = dict(zip(map(id, instant.frames), _first_rows(instant.frames).tolist(), strict=True))
        rows = [part.rows(first) for part in self._parts]
        sighting = np.concatenate([np.empty(0, np.intp), *rows])
        disc = np.concatenate([np.empty(0, np.intp), *(part.disc for part in self._parts)])
        order = np.argsort(sighting)[np.count_nonzero(sighting < 0) :]
        return sightings, Assignments.of(sighting[order], disc[order])

    def _match(self, sightings: DetectionTable) -> tuple[Index, Index]:
        """Rows of the sightings and of the catalogue."""
        exposures = sightings.exposures
        pairs, cost = self._expected.candidates(
            self._optics.pose(self._states, exposures),
            sightings.frame,
            sightings.xy,
            sightings.scale,
            sightings.cov,
            sightings.axes_px[0],
            self._optics.focal[exposures.camera],
        )
        marker, sighting = pairs[:, assign(pairs, cost, sightings.frame)]
        return sighting, self._markers[marker]


def _first_rows(frames: Sequence[CalibratedFrame]) -> Index:
    """Where each frame's detections begin, of all of them one after the other."""
    return np.cumsum([0, *(len(frame.roundels) for frame in frames)])[:-1]


def assign(pairs: Index, cost: Array, frame: Index) -> Index:
    """The rows of the cheapest pairs, as many as there can be in each frame; what has no rival needs no search.

    Args:
        pairs: (2, K) markers and sightings.
        cost: (K,), each less than `UNMATCHED`.
        frame: (N,) of the sightings.
    """
    marker, sighting = pairs
    place = frame[sighting] * (np.max(marker, initial=0) + 1) + marker  # of a marker in a frame
    rivals = np.maximum(np.bincount(place)[place], np.bincount(sighting)[sighting])
    alone, contested = np.flatnonzero(rivals == 1), np.flatnonzero(rivals > 1)
    at = frame[sighting[contested]]
    parts = [contested] if len(contested) < TOGETHER else [contested[at == k] for k in set(at.tolist())]
    chosen = [rows[_assign_rivals(place[rows], sighting[rows], cost[rows])] for rows in parts]
    return np.concatenate([alone, *chosen])


def _assign_rivals(place: Index, sighting: Index, cost: Array) -> Index:
    i, n = _renumber(place)
    j, m = _renumber(sighting)
    costs, number = np.full((n, m), UNMATCHED), np.full((n, m), -1)
    costs[i, j], number[i, j] = cost, np.arange(len(cost))
    chosen = number[linear_sum_assignment(costs)]
    return chosen[chosen >= 0]


def _renumber(rows: Index) -> tuple[Index, int]:
    """Rows counted from 0 without gaps, and how many there are."""
    new = np.cumsum(np.bincount(rows) > 0)
    return new[rows] - 1, int(new[-1]) if len(new) else 0
