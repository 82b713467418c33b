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

import numpy as np

from camera_node.arrays import Array, Index, Mask
from fusion.model.camera_array import CameraArray
from fusion.model.observations import DetectionTable, MarkerTable, MatchedObservations
from fusion.monitoring.frame_consistency import AssignedFrames
from fusion.tracking.estimator import Estimator

LEARNED = 8  # frames of a camera that define the usual number of detections of a robot
MISSED = np.log(0.1)  # 1 - P_D of a marker that was usually seen
# Of a robot or its view in a camera from one frame to the next: hidden, or visible again.
CHANGED = np.log(0.02)
LOG_2PI = np.log(2 * np.pi)


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
        view = robot * self._shape[1] + given.detections.camera[given.assignments.detection]
        frames = np.bincount(given.detections.exposures.camera, minlength=self._shape[1])
        count = self._count(view)
        missing = np.maximum(self._usual * frames - count, 0)
        cost = np.maximum(missing * MISSED, CHANGED).sum(1)
        fallen = (count.sum(1) > 0) & (missing.sum(1) > count.sum(1))
        unseen = self._unseen & (count > 0) & ~fallen[:, None]
        own = ~(fallen[robot] | unseen.ravel()[view])
        groups = [(robot == row, cost[row] - CHANGED) for row in np.flatnonzero(fallen).tolist()]
        groups += [(view == at, CHANGED) for at in np.flatnonzero(unseen).tolist()]
        beyond_question = own.copy()
        density = self._density(given.detections) if groups else np.empty(0)
        for rows, prior in groups:
            beside = beyond_question & (robot == robot[rows][0])
            own[rows] = prior + self._log_ratio(given, rows, beside, density) > 0
        self._learn(self._count(view[own]), frames, given.tracked)
        return own

    def _log_ratio(self, given: AssignedFrames, rows: Mask, beside: Mask, density: Array) -> float:
        """Log-likelihood of assignments `rows` as those of their robot, minus that as any roundels of their images.

        The likelihood is conditional on the robot's assignments `beside`. `density` (F,) is that of all roundels in the
        frames, per pixel^2.
        """
        both = np.flatnonzero(rows | beside)
        observations = MatchedObservations.of(given.assignments.select(both), given.detections, self._markers)
        A, nu = self._estimator.innovations(given.states, observations)
        S = A @ given.states.P[observations.discs.body[0]] @ A.T + np.eye(len(nu))
        known, new = np.repeat(beside[both], 2), rows[both]
        cov = observations.detections.cov[:, :, new].transpose(2, 0, 1)
        likelihood = _log_normal(nu, S) - _log_normal(nu[known], S[np.ix_(known, known)])
        likelihood -= 0.5 * np.log(np.linalg.det(cov)).sum()  # of pixels instead of whitened centres
        return float(likelihood - np.log(density[observations.detections.frame[new]]).sum())

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
        self._usual[~expected] = self._learned[~expected] = self._unseen[~expected] = 0
        at = np.ix_(expected, frames > 0)
        self._unseen[at] = count[at] == 0
        self._learned[at] += 1
        rate = 1 / np.minimum(self._learned[at], LEARNED)
        self._usual[at] += rate * (count[at] / frames[frames > 0] - self._usual[at])


def _log_normal(x: Array, S: Array) -> float:
    """Log-density of a normal distribution of covariance S at a distance x from its mean."""
    return float(-0.5 * (x @ np.linalg.solve(S, x) + np.linalg.slogdet(S)[1] + len(x) * LOG_2PI))
