# SPDX-License-Identifier: BSD-3-Clause
"""Finds frames that contradict the tracked robots, before they change any state.

A camera that is moved, turned or given another clock still detects roundels, but in its very next frame hardly any of
them are where tracked robots are expected. Such a frame is not used. Which fault it is, and what to do about it, is
for the monitors of clocks and extrinsics to find out.
"""

from dataclasses import dataclass

import numpy as np

from camera_node.foundation.arrays import Array, Index, Mask
from fusion.model.expected_views import ExpectedViews
from fusion.model.observations import Assignments, CameraArray, DetectionTable, MarkerTable
from fusion.model.states import States
from fusion.monitoring.residual_monitor import LEARNED

MIN_USUAL = 8.0  # assigned detections, from which a frame is judged
FALLEN, AGREEING = 0.6, 0.8  # shares of the usual number: below, a frame is suspicious; above, it agrees
MIN_DETECTED = 0.6  # of the usual number: a camera that sees little contradicts nothing
CONTRADICTS = 0.5  # of the expected markers: with fewer of them assigned, a frame contradicts the robots
MIN_EXPECTED = 6  # markers, from which a frame is judged
MIN_OTHERS = 2  # other cameras that agree


@dataclass(frozen=True, slots=True, eq=False)
class AssignedFrames:
    """Frames of a frame set with their assignments before the update.

    Attributes:
        states: predicted robots.
        tracked: (R,) robots whose detections were assigned.
        detections: of all frames.
        assignments: of the detections.
    """

    states: States
    tracked: Mask
    detections: DetectionTable
    assignments: Assignments


class FrameConsistency:
    """The usual number of assigned detections of each camera, whether a frame contradicts the others.

    Args:
        cameras: cameras of the rig.
        markers: of all robots.
    """

    def __init__(self, cameras: CameraArray, markers: MarkerTable) -> None:
        self._cameras, self._markers = cameras, markers
        n = len(cameras.names)
        self._usual, self._learned = np.zeros(n), np.zeros(n, np.intp)

    def contradicting(self, given: AssignedFrames) -> Index:
        """Rows of the frames that contradict the robots while two other cameras agree with them."""
        frames = given.detections.exposures.camera
        n, usual = len(frames), self._usual[frames]
        detected = np.bincount(given.detections.frame, minlength=n)
        assigned = np.bincount(given.detections.frame[given.assignments.detection], minlength=n)
        judged = (self._learned[frames] >= LEARNED) & (usual >= MIN_USUAL)
        suspicious = judged & (assigned < FALLEN * usual) & (detected >= MIN_DETECTED * usual)
        agreeing = len(np.unique(frames[judged & (assigned >= AGREEING * usual)]))
        wrong = np.zeros(n, bool)
        if agreeing >= MIN_OTHERS:
            for row in np.flatnonzero(suspicious).tolist():
                wrong[row] = self._contradicts(given, row)
        self._learn(frames[~wrong], assigned[~wrong].astype(float))
        return np.flatnonzero(wrong)

    def _contradicts(self, given: AssignedFrames, row: int) -> bool:
        """Whether most of the markers that a frame should show were not assigned in it."""
        seen, exposures = given.detections, given.detections.exposures
        rows = np.flatnonzero(given.tracked[self._markers.robot])
        name, tau = self._cameras.names[exposures.camera[row]], float(exposures.tau[row])
        expected = ExpectedViews.of(self._cameras, name, given.states, tau, (self._markers, rows))
        assigned = given.assignments.marker[seen.frame[given.assignments.detection] == row]
        agreeing = int(np.isin(expected.rows, assigned).sum())
        return len(expected.rows) >= MIN_EXPECTED and agreeing < CONTRADICTS * len(expected.rows)

    def _learn(self, cameras: Index, assigned: Array) -> None:
        self._learned[cameras] += 1
        rate = 1 / np.minimum(self._learned[cameras], LEARNED)
        self._usual[cameras] += rate * (assigned - self._usual[cameras])
