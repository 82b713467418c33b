# SPDX-License-Identifier: BSD-3-Clause
"""Compares the clocks of the cameras by the robots that move; docs/design/time_offsets.md.

0.1 s after a frame set   -> `offset_information` -> `DriftMonitor` -> a slow departure
"""

from collections import deque
from collections.abc import Collection

import numpy as np

from camera_node.foundation.arrays import Mask
from fusion.model.observations import (
    Assignments,
    CameraArray,
    DetectionTable,
    MarkerTable,
    MatchedObservations,
)
from fusion.model.states import Snapshot
from fusion.monitoring.clocks.clock_drift import HALF_NS, Drift, DriftMonitor, with_mean_velocities
from fusion.monitoring.clocks.time_offsets import offset_information
from fusion.monitoring.clocks.time_search import RANGE_S

CHECKED_NS = 400_000_000  # between searches for a drift
LAGGED_NS = 130_000_000  # between comparisons, which wait for the motion after the frame set
DRIFT_SIGMA_V = 0.1  # of a mean velocity, m/s
MAX_MARKERS = 96  # observations of a frame set that are compared
MIN_SPEED_M_S = 0.03  # of a robot that is compared


class ClockComparison:
    """The information of the last frame sets about the offsets of the cameras from their corrected stamps.

    Args:
        cameras: cameras of the rig.
        markers: of all robots.
        single: as in `Estimator`.

    Attributes:
        history: the robots over the last seconds.
    """

    def __init__(self, cameras: CameraArray, markers: MarkerTable, single: Mask) -> None:
        self._cameras, self._markers, self._single = cameras, markers, single
        self.history: deque[Snapshot] = deque()
        self._drifts = DriftMonitor()
        self._lagged: deque[tuple[Snapshot, MatchedObservations]] = deque()
        self._now_ns = self._lagged_ns = self._checked_ns = 0

    def observe(self, now: Snapshot) -> None:
        """Add the robots at the next frame set to the history."""
        self._now_ns = now.t_ns
        self.history.append(now)
        while self.history[0].t_ns < now.t_ns - (RANGE_S + 0.5) * 1e9:
            self.history.popleft()

    def add(self, detections: DetectionTable, assignments: Assignments) -> None:
        """Keep detections of the last observed frame set, if it is time, until the motion after it is known."""
        if self._now_ns < self._lagged_ns + LAGGED_NS:
            return
        chosen = self._choose(self.history[-1], detections, assignments)
        if len(chosen):
            self._lagged_ns = self._now_ns
            observations = MatchedObservations.of(chosen, detections, self._markers)
            self._lagged.append((self.history[-1], observations))

    def drifts(self, departing: Collection[int]) -> list[Drift]:
        """The cameras that depart slowly from the others; empty most of the time, since this is searched for rarely.

        Args:
            departing: indices of the cameras that departed lately.
        """
        while self._lagged and self._now_ns >= self._lagged[0][0].t_ns + HALF_NS:
            snapshot, observations = self._lagged.popleft()
            states, known = with_mean_velocities(snapshot, self.history)
            observations = observations.select(known[observations.discs.body])
            info = offset_information(self._cameras, states, observations, self._single, DRIFT_SIGMA_V)
            self._drifts.add(snapshot.t_ns, info)
        if self._now_ns < self._checked_ns + CHECKED_NS:
            return []
        self._checked_ns = self._now_ns
        return self._drifts.changes(departing) or self._drifts.offsets()

    def correct(self, drift: Drift) -> None:
        """The stamps of a camera are corrected by a drift."""
        self._drifts.correct(drift)
        self.forget_latest()

    def forget(self) -> None:
        """Drop all information about offsets."""
        self.forget_latest()
        self._drifts.forget()

    def forget_since(self, t_ns: int) -> None:
        """Drop the information of frames with an earlier correction, or of excluded cameras."""
        self.forget_latest()
        self._drifts.forget_since(t_ns)

    def forget_latest(self) -> None:
        """Drop the information of the last frame sets, which is not in the windows of drifts yet."""
        self._lagged.clear()

    def _choose(self, now: Snapshot, detections: DetectionTable, assignments: Assignments) -> Assignments:
        """Observations of the fastest of the robots that move, `MAX_MARKERS` at most."""
        speed = np.linalg.norm(now.states.v, axis=1)
        robots = now.tracked & (speed > MIN_SPEED_M_S)
        robot = self._markers.robot[assignments.marker]
        count = np.bincount(robot, minlength=len(robots))
        order = np.argsort(-speed * robots)
        fits = robots[order] & (np.cumsum(count[order]) <= max(MAX_MARKERS, count[order][:1].sum()))
        return assignments.select(np.isin(robot, order[fits]))
