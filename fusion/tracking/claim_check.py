# SPDX-License-Identifier: BSD-3-Clause
"""Compares residuals with their claims, and names the camera or the robot that contradicts the others.

The squared residuals of a robot's detections in a frame set, in claimed standard deviations, have an expected sum:
their number less what the estimate absorbs (redundancy, Baarda 1968). Sums over some seconds are compared. A camera is
named if all residuals fit once it is left out, and not once any other is; of three cameras none, since two that moved
together look like the third. A robot is named if it contradicts with and without each camera, and others of its cameras
fit.

The errors of the rig are the same in all frame sets, so they do not average: their part of the expectation has the
degrees of freedom of one pose (Satterthwaite 1946).
"""

import logging
from dataclasses import dataclass
from itertools import compress
from typing import Literal

import numpy as np
from scipy.special import chdtri

from camera_node.foundation.arrays import Array, Index, Mask
from fusion import _core
from fusion.model.observations import (
    Assignments,
    DetectionTable,
    MarkerTable,
    MatchedObservations,
)
from fusion.model.states import States
from fusion.protocol.arena_health import describe_contradiction
from fusion.protocol.pose_messages import Contradiction
from fusion.rig_graph.hypotheses import MIN_FOR_PAIRS
from fusion.tracking.estimator import Estimator, Prediction
from fusion.tracking.gating import POSE_DEGREES

SAMPLE_EVERY, SAMPLE = 8, 4  # frame sets, and robots of one: a few milliseconds for any number of robots
MEMORY = 40  # samples of a robot: 5 s at 60 Hz
CLAIM_RATIO = 1.5  # of squared errors to claims: less does not change what a claim means
FALSE_ALARM = 1e-6  # of one comparison: one in a month of ten comparisons a second
MIN_REDUNDANCY = 1.0  # of a frame set: with less, everything fits
# Of the squared errors of one sample to their claims, where it is compared: a robot of which a detection was another's
# in two samples of those that are remembered contradicts nothing.
MAX_RATIO = (CLAIM_RATIO - 1) * MEMORY / 2
log = logging.getLogger("fusion")


@dataclass(slots=True)
class _Sums:
    """Decaying sums of the samples, of any shape.

    Attributes:
        squares: of residuals in claimed standard deviations.
        bounded: the same, of each sample at most `MAX_RATIO` times what is expected.
        redundancy: what noise and the rig's errors make of them.
        rig: the part by the rig's errors.
        squares_m2: of the errors of detections at the distance of their markers, square metres.
        count: of detections.
    """

    squares: Array
    bounded: Array
    redundancy: Array
    rig: Array
    squares_m2: Array
    count: Array

    @classmethod
    def zeros(cls, *shape: int) -> "_Sums":
        return cls(*np.zeros((6, *shape)))

    def add(self, row: int | tuple[int, Index], sample: Array) -> None:
        """Add a sample (6,) to one row, or samples (6, L) to L; those before lose weight."""
        columns = self.squares, self.bounded, self.redundancy, self.rig, self.squares_m2, self.count
        for column, value in zip(columns, sample, strict=True):
            column[row] += value - column[row] / MEMORY

    def ratio(self) -> Array:
        """Squared errors over their claims; 0 where nothing could contradict."""
        return self._ratio(self.squares)

    def _ratio(self, squares: Array) -> Array:
        expected = self.redundancy
        return np.divide(squares, expected, out=np.zeros_like(expected), where=expected > 0)

    def contradicts(self) -> Mask:
        """Where the squared errors exceed their claims significantly."""
        expected = np.maximum(self.redundancy, 1e-9)
        degrees = expected**2 / (expected - self.rig + self.rig**2 / POSE_DEGREES)
        bound = chdtri(np.maximum(degrees, 1e-3), FALSE_ALARM) / np.maximum(degrees, 1e-3)
        return (self.redundancy > MIN_REDUNDANCY) & (
            self._ratio(self.bounded) > np.maximum(CLAIM_RATIO, bound)
        )


class ClaimCheck:
    """The residuals of the last seconds, by robot, and as they are without each camera.

    Args:
        estimator: of the robots.
        markers: of all robots.
        names: of the robots.
    """

    def __init__(self, estimator: Estimator, markers: MarkerTable, names: tuple[str, ...]) -> None:
        self._estimator, self._markers, self._names = estimator, markers, names
        self._turn = self._next = 0
        self._reported: set[tuple[str, ...]] = set()
        self.forget()

    def forget(self) -> None:
        """The cameras are others, or elsewhere: samples before blame robots for what a camera did."""
        n, c = len(self._names), len(self._estimator.cameras.names)
        self._all, self._without = _Sums.zeros(n), _Sums.zeros(n, c)
        self._left_out_m2, self._left_out = np.zeros(
            (2, n, c)
        )  # errors of a camera by the others: sums, counts
        self._samples = np.zeros(n, int)

    def observe(
        self, prediction: Prediction, states: States, detections: DetectionTable, assignments: Assignments
    ) -> None:
        """Take some robots of every eighth frame set.

        Args:
            prediction, states: of the robots before and after the update.
            detections, assignments: of the frame set.
        """
        self._turn += 1
        if self._turn % SAMPLE_EVERY or not len(assignments):
            return
        owner = self._markers.robot[assignments.marker]
        robots = np.unique(owner)
        chosen = np.roll(robots, -int(np.searchsorted(robots, self._next)))[:SAMPLE]
        self._next = int(chosen[-1]) + 1
        rows = np.flatnonzero(np.isin(owner, chosen))
        observations = MatchedObservations.of(assignments.select(rows), detections, self._markers)
        observations = self._estimator.with_time_errors(states, observations)
        A, nu = self._estimator.innovations(states, observations)
        A, nu = A.reshape(-1, 2, 12), nu.reshape(-1, 2)
        metres, rig = self._sizes(states, observations)
        moved = states.minus(prediction.states)
        for robot in chosen.tolist():
            mine = np.flatnonzero((owner[rows] == robot) & np.isfinite(nu).all(axis=1))
            camera = detections.camera[assignments.detection[rows[mine]]]
            equations = _Equations(A[mine], nu[mine], metres[mine], rig[mine])
            self._sample(robot, camera, equations, prediction.information[robot], moved[robot])

    def _sample(
        self, robot: int, camera: Index, equations: "_Equations", information: Array, moved: Array
    ) -> None:
        seeing = np.unique(camera)
        used = np.concatenate([np.ones((1, len(camera)), bool), camera != seeing[:, None]])
        samples, left_out_m2 = equations.solve(used, information, moved)  # by all cameras, and without each
        self._all.add(robot, samples[:, 0])
        self._samples[robot] += 1
        others = np.delete(np.arange(self._without.squares.shape[1]), seeing)
        self._without.add((robot, others), samples[:, :1])
        self._without.add((robot, seeing), samples[:, 1:])
        for sums, values in (self._left_out_m2, left_out_m2), (self._left_out, np.sum(~used, axis=1)):
            sums[robot, seeing] += values[1:] - sums[robot, seeing] / MEMORY

    def contradictions(self) -> tuple[Contradiction, ...]:
        """What contradicts the claims; logs each when it first appears."""
        found = self._contradictions()
        for contradiction in found:
            if contradiction.names not in self._reported:
                log.warning(describe_contradiction(contradiction))
        self._reported = {contradiction.names for contradiction in found}
        return found

    def _contradictions(self) -> tuple[Contradiction, ...]:
        """One camera, robots, or cameras of which nothing decides which one is wrong."""
        known = self._samples >= MEMORY // 2
        bad = self._all.contradicts() & known
        if not bad.any():
            return ()
        involved, cleared = (self._left_out[rows].sum(axis=0) > 0 for rows in (bad, known & ~bad))
        still = self._without.contradicts() | (self._without.redundancy <= MIN_REDUNDANCY)
        explains = involved & ~still[bad].any(axis=0) & ~cleared
        if explains.sum() == 1 and involved.sum() > MIN_FOR_PAIRS:
            errors_m2 = self._left_out_m2[bad][:, explains].sum() / self._left_out[bad][:, explains].sum()
            return (self._describe("camera", bad, explains, errors_m2),)
        are_own = (self._without.contradicts() | (self._left_out == 0))[bad].all()
        if are_own and (cleared[involved].all() or known.sum() == 1):
            rows = np.eye(len(bad), dtype=bool)[bad]
            return tuple(self._describe("robot", row, involved, self._mean_m2(row)) for row in rows)
        several = explains if explains.sum() > 1 else involved
        return (self._describe("undecided", bad, several, self._mean_m2(bad)),)

    def _mean_m2(self, robots: Mask) -> float:
        """The mean squared error of the detections of these robots, square metres."""
        return float(self._all.squares_m2[robots].sum() / self._all.count[robots].sum())

    def _describe(
        self, kind: Literal["camera", "robot", "undecided"], robots: Mask, cameras: Mask, error_m2: float
    ) -> Contradiction:
        of_robots = kind == "robot"
        names, chosen = (self._names, robots) if of_robots else (self._estimator.cameras.names, cameras)
        return Contradiction(
            kind=kind,
            names=tuple(compress(names, chosen.tolist())),
            error_over_claim=float(self._all.ratio()[robots].max()),
            size_mm=1e3 * float(np.sqrt(error_m2)),
        )

    def _sizes(self, states: States, observations: MatchedObservations) -> tuple[Array, Array]:
        """One claimed standard deviation of N detections at the distance of their markers, metres (N,), and the part
        of their variances that is the rig's (N,)."""
        cameras, seen = self._estimator.cameras, observations.detections
        centre = cameras.views(states, seen.exposures, observations.discs).centre
        weight = np.abs(_determinant(observations.whiten))  # of squares in the image plane
        rig_px2 = cameras.error_px[seen.camera] ** 2
        return centre[2] / np.sqrt(weight), rig_px2 / seen.variance_px2


def _determinant(matrices: Array) -> Array:
    """(N,) of matrices (2, 2, N)."""
    (a, b), (c, d) = matrices
    return np.asarray(a * d - b * c)


@dataclass(frozen=True, slots=True, eq=False)
class _Equations:
    """N detections of one robot, linearized: derivatives (N, 2, 12), innovations (N, 2), metres (N,) and rig (N,)."""

    A: Array
    nu: Array
    metres: Array
    rig: Array

    def solve(self, used: Mask, information: Array, moved: Array) -> tuple[Array, Array]:
        """The samples of `_Sums` (6, L) of L estimates, and the squared errors (L,), m^2, of the detections that each
        leaves out.

        Args:
            used: (L, N) the detections of each.
            information: (12, 12) of the prediction.
            moved: (12,) from the prediction to the linearization.
        """
        of_each = np.einsum("nai,naj->nij", self.A, self.A).reshape(len(self.A), -1)
        gained = (used @ of_each).reshape(-1, 12, 12)
        P = _core.inverses(information + gained)
        right = used @ np.einsum("nai,na->ni", self.A, self.nu) - information @ moved
        x = np.einsum("lij,lj->li", P, right)
        squares = np.sum((self.nu - np.einsum("nai,li->lna", self.A, x)) ** 2, axis=2)
        squares_m2, count = squares * self.metres**2, used.sum(axis=1)
        redundancy = 2 * count - np.einsum("lij,lij->l", P, gained)
        whole = np.sum(squares, axis=1, where=used)
        sample = (
            whole,
            np.minimum(whole, MAX_RATIO * redundancy),
            redundancy,
            redundancy * (used @ self.rig) / np.maximum(count, 1),
            np.sum(squares_m2, axis=1, where=used),
            count,
        )
        return np.array(sample), np.sum(squares_m2, axis=1, where=~used)
