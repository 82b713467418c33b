# SPDX-License-Identifier: BSD-3-Clause
"""Finds robots with discs of another diameter than declared: they look larger or smaller than they are at the range
that several cameras triangulate."""

import logging

import numpy as np

from camera_node.detection.disc_pose import decompose
from camera_node.foundation.arrays import Array, Index
from fusion.model.observations import Assignments, CameraArray, DetectionTable, MarkerTable
from fusion.model.states import States

# Every eighth frame set, the sizes of so many detections are measured: a millisecond for any number of robots.
SAMPLE_EVERY, SAMPLE = 8, 128
MIN_MEASURED = 100  # detections of a robot
MAX_SIZE_ERROR = 0.05  # of a declared diameter; thresholds and blur change apparent sizes by 1 to 3 %
MAX_LOG_RATIO = 0.3  # larger ratios count as this: a partly covered disc decides nothing
log = logging.getLogger("fusion")


class SizeCheck:
    """Running mean of the apparent diameter of each robot's discs, in declared diameters.

    Args:
        names, diameters: (N,) of the robots, metres.
        cameras: cameras of the rig.
        markers: of all robots.
    """

    def __init__(
        self, names: tuple[str, ...], diameters: Array, cameras: CameraArray, markers: MarkerTable
    ) -> None:
        self._names, self._diameters = names, diameters
        self._cameras, self._markers = cameras, markers
        self._mean_log, self._count = np.zeros(len(names)), np.zeros(len(names), int)
        self._turn = 0
        self._reported: set[str] = set()

    def observe(self, states: States, detections: DetectionTable, assignments: Assignments) -> None:
        """Measure the discs of some assigned detections of a frame set, of others the next time."""
        rows = self._sample(len(assignments))
        if not len(rows):
            return
        marker, seen = assignments.marker[rows], detections.select(assignments.detection[rows])
        owner = self._markers.robot[marker]
        arms = np.einsum("nij,jn->ni", states.R[owner], self._markers.position.take(marker, 1))
        self._measure(seen, owner, states.p[owner] + arms)

    def _sample(self, n: int) -> Index:
        """The rows, of n detections, to measure in this frame set."""
        self._turn += 1
        if not n or self._turn % SAMPLE_EVERY:
            return np.arange(0)
        step = -(-n // SAMPLE)
        return np.arange(self._turn // SAMPLE_EVERY % step, n, step)

    def _measure(self, detections: DetectionTable, robot: Index, position: Array) -> None:
        """Measure the discs of detections (N,) of robots (N,), whose centres are at positions (N, 3), world."""
        known = np.flatnonzero(np.isfinite(detections.axes_px[1]) & np.isfinite(detections.xy[0]))
        if not len(known):
            return
        seen, robot = detections.select(known), robot[known]
        # Range of a disc of radius 1.
        unit_m = np.linalg.norm(decompose(seen.conics(), 1.0)[0], axis=2).mean(1)
        range_m = np.linalg.norm(position[known] - self._cameras.centres[seen.camera], axis=1)
        log_ratio = np.log(2 * range_m / unit_m / self._diameters[robot])
        measured, n = np.isfinite(log_ratio), len(self._count)
        robot, bounded = robot[measured], np.clip(log_ratio[measured], -MAX_LOG_RATIO, MAX_LOG_RATIO)
        count = np.bincount(robot, minlength=n)
        self._count += count
        remembered = np.maximum(np.minimum(self._count, MIN_MEASURED), np.maximum(count, 1))
        self._mean_log += (np.bincount(robot, bounded, n) - count * self._mean_log) / remembered

    def misfits(self) -> dict[str, float]:
        """Measured diameters, metres, of robots with another declared one; logs each robot when it first appears."""
        ratio = np.exp(self._mean_log)
        rows = np.flatnonzero((self._count >= MIN_MEASURED) & (np.abs(ratio - 1) > MAX_SIZE_ERROR))
        found = {self._names[k]: float(ratio[k] * self._diameters[k]) for k in rows}
        for name in found.keys() - self._reported:
            log.warning(
                "robot %s: its discs measure %.1f mm, other than diameter_m in robots.yaml; correct that, or, if all "
                "robots differ, the lengths in wand.yaml",
                name,
                1e3 * found[name],
            )
        self._reported = set(found)
        return found
