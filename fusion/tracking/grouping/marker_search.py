# SPDX-License-Identifier: BSD-3-Clause
"""Searches the unassigned detections of a frame set for markers: of the declared sizes, and at times of others."""

import numpy as np

from camera_node.foundation.arrays import Array, Index
from fusion.model.observations import Assignments, CameraArray, DetectionTable, MarkerTable
from fusion.tracking.gating import ANY_DIAMETERS, DIAMETER_TOLERANCE
from fusion.tracking.grouping.multiview import Marker, find_markers
from fusion.tracking.grouping.portions import Portion, limit_of, portion_of

# Unassigned detections that no missing robot explains: the largest number of their pairs between different frames. Of
# more, those around one of them are searched, each in its turn: a robot among false detections is acquired later.
MAX_PAIRS = 80_000
# The same of detections that no declared size explains, above which other sizes are not searched for: a new robot is
# defined where little else is unassigned, and poses must not wait for it. That is 25 in each frame of 8 cameras.
MAX_OTHER_PAIRS = 20_000
OTHERS_EVERY = 8  # frame sets from one search for other sizes to the next, while none is found


class MarkerSearch:
    """Triangulates markers from unassigned detections.

    Args:
        cameras: cameras of the rig.
        leads: whether this shard reports markers that no robot declares.

    Attributes:
        n_frame_sets: with unassigned detections, so far.
    """

    def __init__(self, cameras: CameraArray, leads: bool) -> None:
        self._cameras, self._leads = cameras, leads
        self.n_frame_sets = 0
        self._has_others = False  # whether the last search for other sizes found markers

    def find(
        self, declared: MarkerTable, n_missing: int, detections: DetectionTable, assignments: Assignments
    ) -> tuple[list[Marker], Index]:
        """Triangulate markers from unassigned detections; and the cameras that have too many of these.

        With part of the detections, a robot can be taken for another one whose markers are not in this part. So all are
        searched that the markers of missing robots can explain.

        Args:
            declared: the markers of all robots.
            n_missing: how many markers untracked robots have.
            detections: of a frame set.
            assignments: of the tracked robots.
        """
        free = np.ones(len(detections), bool)
        free[assignments.detection] = False
        diameters = np.unique(2 * declared.radius) if len(declared) else np.array(ANY_DIAMETERS)
        if not free.any():
            return [], free.nonzero()[0][:0]
        self.n_frame_sets += 1
        limit = n_missing + limit_of(len(detections.exposures.camera), MAX_PAIRS)
        portion = Portion(limit, self.n_frame_sets, float(np.median(diameters)))
        rows, crowded = portion_of(self._cameras, detections, np.flatnonzero(free), portion)
        markers = find_markers(self._cameras, detections, rows, diameters)
        if self._leads and len(declared) and (self._has_others or self.n_frame_sets % OTHERS_EVERY == 0):
            others = self._find_other_sizes(detections, rows, markers, diameters)
            self._has_others = len(others) > 0
            markers += others
        return markers, crowded

    def _find_other_sizes(
        self, detections: DetectionTable, rows: Index, markers: list[Marker], diameters: Array
    ) -> list[Marker]:
        """Triangulate markers that no robot declares: a new robot may have another diameter.

        Args:
            detections: of a frame set.
            rows: that were searched.
            markers: that were found, of the declared `diameters`.
        """
        rest = np.setdiff1d(rows, np.concatenate([rows[:0], *(marker.detections for marker in markers)]))
        rest = rest[np.isfinite(detections.axes_px[0, rest])]
        count = np.bincount(detections.frame[rest])
        if not 0 < (count.sum() ** 2 - (count**2).sum()) // 2 <= MAX_OTHER_PAIRS:
            return []
        others = find_markers(self._cameras, detections, rest, np.array(ANY_DIAMETERS))
        size = np.array([marker.diameter_m for marker in others])
        is_other = np.all(np.abs(size[:, None] / diameters - 1) > DIAMETER_TOLERANCE, axis=1)
        return [others[k] for k in np.flatnonzero(is_other)]
