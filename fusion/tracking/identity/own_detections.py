# SPDX-License-Identifier: BSD-3-Clause
"""Whether detections of a robot that was differently seen before are its own, or those of other roundels.

A covered robot has detections of others in its gates. Its pose adapts to one or two of them exactly, so that their
residuals show nothing, and the covariance claims what its own markers would determine. The score of detections is the
log-likelihood ratio of both cases (track score: Blackman and Popoli 1999, section 6.2), with innovations nu, the
prediction P, and the density of all roundels in the image:

    log N(nu; 0, H P H^T + R) - n log(density)

A robot of which much is missing needs more than what its missing markers cost: log(1 - P_D) each, and at most the
probability that something hides them from a camera. A camera that did not see the robot needs more than the
probability that it does now.
"""

from dataclasses import dataclass

import numpy as np

from camera_node.foundation.arrays import Array, Index, Mask
from fusion.model.observations import CameraArray, DetectionTable, MarkerTable, MatchedObservations
from fusion.monitoring.frame_consistency import AssignedFrames
from fusion.tracking.estimator import Estimator

LEARNED = 8  # frames of a camera that define the usual number of detections of a robot
MISSED = np.log(0.1)  # 1 - P_D of a marker that was usually seen
# Of a robot or its view in a camera from one frame to the next: hidden, or visible again.
CHANGED = np.log(0.02)
LOG_2PI = np.log(2 * np.pi)


@dataclass(frozen=True, slots=True, eq=False)
class _Changes:
    """Robots of which much is missing (R,), their views (R, C) that were empty before, and what is missing (R,)."""

    fallen: Mask
    unseen: Mask
    cost: Array


@dataclass(frozen=True, slots=True, eq=False)
class _Evidence:
    """Linearized assignments: whitened derivatives A (N, 2, 12), innovations nu (N, 2), and the logarithm of the
    density `other` (N,) of other roundels, in units of whitened centres."""

    A: Array
    nu: Array
    other: Array

    def log_ratio(self, new: Mask, beside: Mask, P: Array) -> float:
        """Log-likelihood of assignments `new` as those of their robot, minus that as any roundels of their images.

        The likelihood is conditional on the robot's assignments `beside`; `P` (12, 12) is the robot's prediction.
        """
        order = np.concatenate([np.flatnonzero(beside), np.flatnonzero(new)])
        A, nu = self.A[order].reshape(-1, 12), self.nu[order].ravel()
        L = np.linalg.cholesky(A @ P @ A.T + np.eye(len(nu)))
        n = 2 * int(new.sum())
        z, pivots = np.linalg.solve(L, nu)[-n:], np.diag(L)[-n:]
        likelihood = -0.5 * (z @ z + n * LOG_2PI) - np.log(pivots).sum()
        return float(likelihood - self.other[new].sum())


class OwnDetections:
    """The usual number of detections of each robot in each camera.

    Args:
        cameras: cameras of the rig.
        estimator: of all robots.
        markers: of all robots.
    """

    def __init__(self, cameras: CameraArray, estimator: Estimator, markers: MarkerTable) -> None:
        self._cameras, self._estimator, self._markers = cameras, estimator, markers
        self._shape = (len(estimator.single), len(cameras.names))
        self._usual, self._learned = np.zeros(self._shape), np.zeros(self._shape, np.intp)
        self._unseen = np.zeros(self._shape, bool)  # in the last frame of the camera

    def are_own(self, given: AssignedFrames) -> Mask:
        """(N,) assignments of a frame set that are more probable than detections of something else."""
        robot = self._markers.robot[given.assignments.marker]
        frame = given.detections.frame[given.assignments.detection]
        view = robot * self._shape[1] + given.detections.exposures.camera[frame]
        frames = np.bincount(given.detections.exposures.camera, minlength=self._shape[1])
        count = self._count(view)
        missing = np.maximum(self._usual * frames - count, 0)
        cost = np.maximum(missing * MISSED, CHANGED).sum(1)
        fallen = (count.sum(1) > 0) & (missing.sum(1) > count.sum(1))
        unseen = self._unseen & (count > 0) & ~fallen[:, None]
        own = ~(fallen[robot] | unseen.ravel()[view])
        if fallen.any() or unseen.any():
            own[self._accepted(given, view, own, _Changes(fallen, unseen, cost))] = True
        self._learn(self._count(view[own]), frames, given.tracked)
        return own

    def _accepted(self, given: AssignedFrames, view: Index, certain: Mask, changes: _Changes) -> Index:
        """The uncertain assignments that are more probable as those of their robot.

        Args:
            given: N assignments of a frame set.
            view: (N,) of the assignments, robot and camera.
            certain: (N,) assignments that are not to be judged.
            changes: the robots and views whose assignments are uncertain.
        """
        n_cameras = self._shape[1]
        rows = np.flatnonzero((changes.fallen | changes.unseen.any(1))[view // n_cameras])
        robot, camera = np.divmod(view[rows], n_cameras)
        evidence = self._evidence(given, rows)
        groups = [(robot == k, changes.cost[k] - CHANGED) for k in np.flatnonzero(changes.fallen).tolist()]
        groups += [((robot == k) & (camera == c), CHANGED) for k, c in np.argwhere(changes.unseen).tolist()]
        accepted = np.zeros(len(rows), bool)
        for new, prior in groups:
            k = robot[np.argmax(new)]
            accepted[new] = (
                prior + evidence.log_ratio(new, certain[rows] & (robot == k), given.states.P[k]) > 0
            )
        return rows[accepted]

    def _evidence(self, given: AssignedFrames, rows: Index) -> _Evidence:
        observations = MatchedObservations.of(given.assignments.select(rows), given.detections, self._markers)
        A, nu = self._estimator.innovations(given.states, observations)
        cov, frame = observations.detections.cov, observations.detections.frame
        # Of pixels instead of whitened centres.
        log_area = 0.5 * np.log(cov[0, 0] * cov[1, 1] - cov[0, 1] ** 2)
        log_any = np.log(self._density(given.detections)[frame])
        return _Evidence(A.reshape(-1, 2, 12), nu.reshape(-1, 2), log_area + log_any)

    def _density(self, detections: DetectionTable) -> Array:
        """(F,) detections per pixel^2 in the frames up to the last one with a detection."""
        counts = np.bincount(detections.frame)
        lenses = [
            self._cameras[self._cameras.names[k]] for k in detections.exposures.camera[: len(counts)].tolist()
        ]
        return counts / np.array([lens.width * lens.height for lens in lenses], float)

    def _count(self, view: Index) -> Index:
        """(R, C) numbers of assignments."""
        return np.bincount(view, minlength=self._shape[0] * self._shape[1]).reshape(self._shape)

    def _learn(self, count: Index, frames: Index, expected: Mask) -> None:
        """Adapt the usual numbers of expected robots in the cameras that sent frames; forget those of others."""
        known = expected[:, None] & (frames > 0)
        for column in (self._usual, self._learned, self._unseen):
            column[~expected] = 0
        self._unseen = np.where(known, count == 0, self._unseen)
        self._learned += known
        rate = known / np.clip(self._learned, 1, LEARNED)
        self._usual += rate * (count / np.maximum(frames, 1) - self._usual)
