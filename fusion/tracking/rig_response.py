# SPDX-License-Identifier: BSD-3-Clause
"""Claims that contain the errors of the cameras: consider parameters (Schmidt 1966; Bierman 1977, section VIII.4).

The filter holds the cameras fixed. To weigh detections by what they are worth, it counts errors of the cameras as noise
of each detection. But they are the same in all detections of a camera and in all frame sets, so that neither markers
nor time average them. For each robot, two quantities follow the steps of the filter, with P' its prediction, P after
the update, F the transition, A and B the whitened derivatives of the detections by robot and cameras, w their weights,
and E = P P'^-1 = I - K A:

    response of its errors to those of the cameras     S <- E F S - P sum w A^T B
    the part of P that counts the cameras as noise     D <- E F D F^T E^T + P (sum s w A^T A) P

with s the part of a detection's variance that is the cameras'. The claimed covariance is P - D + S R S^T, with R that
of the cameras. It is exact for any gain, so also for robust weights. docs/design/fusion_filter.md has the equations.
"""

from collections.abc import Mapping

import numpy as np

from calib.rig.camera_errors import ERRORS, covariance_factor
from camera_node.foundation.arrays import Array, Index
from fusion import _core
from fusion.model.observations import MarkerTable, MatchedObservations
from fusion.model.states import States, Transition
from fusion.tracking.estimator import Estimator
from fusion.tracking.identification import RefinedFits
from fusion.tracking.robust_update import RobustFit

# Of a rig that may have changed since it was calibrated: each camera turned as if it was touched, by 0.3 degrees with a
# focal length of 840 px, and the size as by a wand that was measured to 5 mm of 0.5 m.
CHANGED_PX, CHANGED_SIZE = 5.0, 0.01


class RigResponse:
    """The responses of N robots to errors of the cameras.

    Args:
        estimator: of the robots.

    Attributes:
        responses: (N, C, 12, 8) derivatives of the errors of the states by those of each camera.
        counted: (N, 12, 12) parts of the filter's covariances that count the errors of cameras as noise.
    """

    def __init__(self, estimator: Estimator) -> None:
        self._cameras, n = estimator.cameras, len(estimator.single)
        self.responses = np.zeros((n, len(self._cameras.names), 12, ERRORS))
        self.counted = np.zeros((n, 12, 12))
        self._factor, self._factor_of = np.zeros((0, 0)), (-1, 0.0, False)

    def inherit(self, old: "RigResponse", same: Mapping[int, int]) -> None:
        """Continue with the robots of another one, whose rows `same` has by row."""
        rows, before = list(same), list(same.values())
        self.responses[rows], self.counted[rows] = old.responses[before], old.counted[before]

    def update(self, fitted: RobustFit) -> None:
        """Follow a step of the filter, whose added noise the detections of a camera have in common."""
        equations = fitted.equations, fitted.weights
        predicted = fitted.prediction.information, fitted.prediction.motion
        self._follow(fitted.states, fitted.observations.matched, equations, predicted, fitted.added_px2)

    def forget(self, rows: Index) -> None:
        """The errors of robots (rows) that start from a state of unknown origin follow none of the cameras."""
        self.responses[rows], self.counted[rows] = 0.0, 0.0

    def restart(self, states: States, fits: RefinedFits, added_px2: float) -> None:
        """Robots that were located without a prediction.

        Args:
            states: of all robots, with those of the fits.
            fits: of the robots.
            added_px2: variance that the fits gave the detections beside their own noise.
        """
        self.forget(fits.robot)
        observations, n = fits.observations.with_bodies(fits.robot[fits.body]), len(states)
        at_rest = Transition(np.zeros((n, 3, 3)), np.zeros(n))
        unknown = np.zeros((n, 12, 12)), at_rest
        self._follow(states, observations, (fits.equations, fits.weights), unknown, added_px2)

    def _follow(
        self,
        states: States,
        observations: MatchedObservations,
        linearized: tuple[Array, Array],
        predicted: tuple[Array, Transition],
        added_px2: float,
    ) -> None:
        """Update by the equations (N, 2, 13) and weights (N,) of observations, and by the information (R, 12, 12) of
        the predictions and the transition to them; robots without observations are predicted."""
        seen, (information, motion) = observations.detections, predicted
        rig_px2 = self._cameras.error_px[seen.camera] ** 2 + added_px2
        _core.respond(
            self._cameras.frame_poses(states, seen.exposures),
            seen.exposures.camera,
            *linearized,
            rig_px2 / seen.variance_px2,
            seen.frame,
            observations.discs.body,
            seen.xy,
            observations.whiten,
            information,
            states.P,
            motion.T,
            motion.dt,
            self.responses,
            self.counted,
        )

    def claimed(
        self, states: States, markers: MarkerTable, added_px2: float = 0.0, may_have_changed: bool = False
    ) -> Array:
        """(N, 12, 12) covariances of the robots that contain the errors of the cameras, and of the places of markers on
        their robots.

        Args:
            states: of the robots.
            markers: of the robots.
            added_px2: variance that the detections of a camera may have in common beside the calibration's error.
            may_have_changed: whether the cameras may have turned, and the rig have another size.
        """
        factor = self._factor_with(added_px2, may_have_changed)
        return _core.consider(states.P, self.counted, self.responses, factor, states.R, markers.frame)

    def _factor_with(self, added_px2: float, may_have_changed: bool) -> Array:
        """(8 C, 8 C) lower triangular factor of the covariance of the cameras, each turned by `added_px2` besides."""
        key = self._cameras.revision, added_px2, may_have_changed
        if key != self._factor_of:
            covariance = self._cameras.covariance.copy()
            turns = np.flatnonzero(np.arange(len(covariance)) % ERRORS < 2)
            px2 = added_px2 + CHANGED_PX**2 * may_have_changed
            covariance[turns, turns] += px2 / self._cameras.focal[turns // ERRORS] ** 2
            of_size = CHANGED_SIZE * may_have_changed * self._cameras.errors_of_size
            factor = covariance_factor(covariance + np.outer(of_size, of_size))
            self._factor, self._factor_of = np.ascontiguousarray(factor), key
        return self._factor
