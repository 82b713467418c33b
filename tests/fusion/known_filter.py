# SPDX-License-Identifier: BSD-3-Clause
"""The tracker's filter with known associations, started at the truth: its covariance is the Cramer-Rao bound of a
filter with this motion model (Tichavsky et al. 1998), and its errors are the best that association can reach."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from calib.rig.camera import Camera
from fusion.model.frames import FrameSet
from fusion.model.observations import Assignments, DetectionTable, MatchedObservations
from fusion.model.robots import Robot
from fusion.model.states import States
from fusion.tracking.tracker import Tracker

Truth = Callable[[int], States]  # at t_ns; the covariances are not used


class KnownFilter:
    """Updates all robots with the detections whose `id` is a row of the marker table.

    Args:
        cameras: the rig, by name.
        robots: by name.
        truth: where the filter starts.
    """

    def __init__(self, cameras: dict[str, Camera], robots: dict[str, Robot], truth: Truth) -> None:
        self._tracker, self._truth = Tracker(cameras, robots), truth
        self._t_ns: int | None = None
        self.states = self._tracker.table.states

    def update(self, frame_set: FrameSet) -> None:
        """Predict and update."""
        tracker = self._tracker
        if self._t_ns is None:
            self.states = replace(self._truth(frame_set.t_ns), P=tracker.table.states.P)
        dt = 1e-3 if self._t_ns is None else (frame_set.t_ns - self._t_ns) * 1e-9
        self._t_ns = frame_set.t_ns
        prediction = tracker.estimator.predict(self.states, np.full(len(self.states), dt))
        detections = DetectionTable.of(frame_set, tracker.cameras)
        number = np.concatenate([frame.roundels.id for frame in frame_set.frames])
        rows = np.flatnonzero(number >= 0)
        assignments = Assignments.of(rows, number[rows].astype(np.intp))
        observations = MatchedObservations.of(assignments, detections, tracker.table.markers)
        self.states, _ = tracker.estimator.update(prediction, observations)
