# SPDX-License-Identifier: BSD-3-Clause
"""Associates detections with the markers of tracked robots.

Each marker is predicted into each frame at the capture time of the frame. Within a gate of its covariance and apparent
size, detections are assigned frame by frame: each detection to one marker at most, at the lowest total cost. The cost
of a pair is its negative log-likelihood (Bar-Shalom et al. 2001, section 6.4), so a vague prediction does not take a
detection that fits an exact one. `native/candidates.cpp` finds the pairs and their costs.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import linear_sum_assignment

from camera_node.foundation.arrays import Array, Index, Mask
from fusion import _core
from fusion.model.frames import CalibratedFrame, FrameSet
from fusion.model.observations import Assignments, CameraArray, DetectionTable, MarkerTable
from fusion.model.states import States
from fusion.tracking.estimator import Prediction

UNASSIGNED_COST = 1e4  # of a marker without a detection: above any sum of costs within gates
MAX_DETECTIONS = 1 << 32  # above the number of detections in any frame set
MAX_JOINT = 150  # contested pairs that one assignment solves for all frames together


@dataclass(frozen=True, slots=True, eq=False)
class _AssignedFrames:
    """Frames that were assigned together: for each assignment the frame, the detection in it, and the marker."""

    frames: tuple[CalibratedFrame, ...]
    frame: Index
    detection: Index
    marker: Index

    def rows(self, first: dict[int, int]) -> Index:
        """Rows of the detections in a frame set, where a frame starts at `first[id(frame)]`; negative if absent."""
        start = np.array([first.get(id(frame), -MAX_DETECTIONS) for frame in self.frames], np.intp)
        return start[self.frame] + self.detection


@dataclass(frozen=True, slots=True, eq=False)
class Association:
    """The assignments of some frames of one frame set; a value, which `extended` leaves unchanged.

    Attributes:
        cameras: cameras of the rig; `revision` is theirs at the prediction.
        marker_table: markers of all robots.
        states: robots predicted at `t_ns`.
        markers: (M,) rows of the marker table: the markers of the tracked robots.
        expected: the same with the covariances of their positions.
        t_ns: time of the frame set.
        floor_px: see `DetectionTable.of`.
        parts: the frames assigned so far.
    """

    cameras: CameraArray
    revision: int
    marker_table: MarkerTable
    states: States
    markers: Index
    expected: _core.ExpectedMarkers
    t_ns: int
    floor_px: float
    parts: tuple[_AssignedFrames, ...] = ()

    @classmethod
    def of(
        cls,
        cameras: CameraArray,
        marker_table: MarkerTable,
        states: States,
        tracked: Mask,
        t_ns: int,
        floor_px: float,
    ) -> "Association":
        """No assignments yet.

        Args:
            cameras: cameras of the rig.
            marker_table: markers of all robots.
            states: robots predicted at `t_ns`.
            tracked: (N,) robots whose markers are expected.
            t_ns: time of the frame set.
            floor_px: see `DetectionTable.of`.
        """
        rows = np.flatnonzero(tracked[marker_table.robot])
        expected = marker_table.expected(rows, states)
        return cls(cameras, cameras.revision, marker_table, states, rows, expected, t_ns, floor_px)

    def is_of(self, t_ns: int, cameras: CameraArray, marker_table: MarkerTable) -> bool:
        """Whether this is of the frame set at `t_ns`, of these markers, and of the present poses of the cameras."""
        return self.t_ns == t_ns and self.marker_table is marker_table and self.revision == cameras.revision

    def pending(self, frames: Sequence[CalibratedFrame]) -> tuple[CalibratedFrame, ...]:
        """The frames that are not assigned yet."""
        assigned = {id(frame) for part in self.parts for frame in part.frames}
        return tuple(frame for frame in frames if id(frame) not in assigned)

    def extended(self, frames: Sequence[CalibratedFrame]) -> "Association":
        """With the pending frames assigned."""
        new = self.pending(frames)
        if not new:
            return self
        detections = DetectionTable.of(FrameSet(self.t_ns, new), self.cameras, self.floor_px)
        detection, marker = self._assign(detections)
        frame = detections.frame[detection]
        part = _AssignedFrames(new, frame, detection - _first_rows(new)[frame], marker)
        return replace(self, parts=(*self.parts, part))

    def collect(self, frame_set: FrameSet) -> tuple[DetectionTable, Assignments]:
        """All detections of the frame set, and its assignments in the order of the detections."""
        detections = DetectionTable.of(frame_set, self.cameras, self.floor_px)
        first = dict(zip(map(id, frame_set.frames), _first_rows(frame_set.frames).tolist(), strict=True))
        marker_of = np.full(len(detections), -1)
        for part in self.parts:
            rows = part.rows(first)
            marker_of[rows[rows >= 0]] = part.marker[rows >= 0]
        detection = np.flatnonzero(marker_of >= 0)
        return detections, Assignments.of(detection, marker_of[detection])

    def _assign(self, detections: DetectionTable) -> tuple[Index, Index]:
        """Rows of the detections and of the marker table."""
        exposures = detections.exposures
        poses = self.cameras.frame_poses(self.states, exposures)
        focal = self.cameras.focal[exposures.camera]
        pairs, cost = self.expected.candidates(poses, detections.columns, focal)
        marker, detection = pairs[:, assign(pairs, cost, detections.frame)]
        return detection, self.markers[marker]


@dataclass(frozen=True, slots=True, eq=False)
class AssociatedFrames:
    """A frame set whose frames may be associated before all of them have arrived.

    Attributes:
        prediction: all robots at the time of the frame set.
        tracked: (R,) robots whose detections are associated; the others are acquired.
        association: the assignments so far.
    """

    prediction: Prediction
    tracked: Mask
    association: Association


def _first_rows(frames: Sequence[CalibratedFrame]) -> Index:
    """The row of each frame's first detection in a detection table."""
    return np.cumsum([0, *(len(frame.roundels) for frame in frames)])[:-1]


def assign(pairs: Index, cost: Array, frame: Index) -> Index:
    """Choose as many pairs as possible in each frame at the lowest total cost.

    Args:
        pairs: (2, K) rows of markers and detections.
        cost: (K,), each below `UNASSIGNED_COST`.
        frame: (N,) of the detections.

    Returns:
        the chosen columns of `pairs`; pairs without a rival are chosen directly.
    """
    marker, detection = pairs
    view = frame[detection] * (np.max(marker, initial=0) + 1) + marker  # of a marker in a frame
    rivals = np.maximum(np.bincount(view)[view], np.bincount(detection)[detection])
    alone, contested = np.flatnonzero(rivals == 1), np.flatnonzero(rivals > 1)
    at = frame[detection[contested]]
    groups = [contested] if len(contested) < MAX_JOINT else [contested[at == k] for k in set(at.tolist())]
    chosen = [rows[_solve_assignment(view[rows], detection[rows], cost[rows])] for rows in groups]
    return np.concatenate([alone, *chosen])


def _solve_assignment(view: Index, detection: Index, cost: Array) -> Index:
    i, n = _renumber(view)
    j, m = _renumber(detection)
    costs, number = np.full((n, m), UNASSIGNED_COST), np.full((n, m), -1)
    costs[i, j], number[i, j] = cost, np.arange(len(cost))
    chosen = number[linear_sum_assignment(costs)]
    return chosen[chosen >= 0]


def _renumber(rows: Index) -> tuple[Index, int]:
    """Rows renumbered from 0 without gaps, and their count."""
    new = np.cumsum(np.bincount(rows) > 0)
    return new[rows] - 1, int(new[-1]) if len(new) else 0
