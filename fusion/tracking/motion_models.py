# SPDX-License-Identifier: BSD-3-Clause
"""Estimates how much each robot accelerates, by a bank of motion models that each frame set weighs.

`robots.yaml` declares what a robot may do. Most of the time it does less, and at rest nothing: a filter that expects
more takes the noise of detections for velocities. So the density of the white noise on acceleration is an unknown of
each robot, at most the declared one, which may change at any time: a Markov chain of models, one for each density
(Blom and Bar-Shalom 1988; Bar-Shalom et al. 2001, section 11.6). With the whitened derivatives A and innovations b of
the detections of a frame set, H = sum A^T A, g = sum A^T b, and P' the covariance of a model's prediction, its
likelihood is

    -2 ln L = ln det P' + ln det(P'^-1 + H) - g^T (P'^-1 + H)^-1 g + constant.

One update follows, with the geometric mean of the densities: the frame set that shows that a robot begins to move
widens the prediction before it is used. Association gates by the declared motion. docs/design/fusion_filter.md,
section 2, has the figures.
"""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from camera_node.foundation.arrays import Index
from fusion import _core
from fusion.model.observations import LinearizedObservations
from fusion.tracking.estimator import Estimator, Prediction

# Of the declared density, as of accelerations of 10 m/s^2 (`aerial`), 2.2, 0.5 and 0.1 m/s^2, which is at rest.
SHARES = np.array([1.0, 1 / 20, 1 / 400, 1 / 8000])
PHASE_S = 0.5  # mean duration of a phase of motion with one density: of starting, driving evenly, or turning


class MotionModels:
    """The probabilities of the models of N robots.

    Args:
        estimator: of the robots.

    Attributes:
        is_sudden: whether most robots of the last frame set began to accelerate at once: they did, or a camera moved.
    """

    def __init__(self, estimator: Estimator) -> None:
        self._estimator, n = estimator, len(estimator.single)
        self.probabilities = np.tile(SHARES == 1, (n, 1)).astype(float)
        self.is_sudden = False

    def restart(self, rows: Index | slice = slice(None)) -> None:
        """Expect the declared motion of robots: of those that were acquired, or of all."""
        self.probabilities[rows], self.is_sudden = SHARES == 1, False

    def inherit(self, old: "MotionModels", same: Mapping[int, int]) -> None:
        """Continue with the robots of another one, whose rows `same` has by row."""
        self.probabilities[list(same)] = old.probabilities[list(same.values())]

    def narrowed(self, prediction: Prediction, observations: LinearizedObservations) -> Prediction:
        """The prediction by the densities that the observations show; by the declared ones of robots that fewer than
        two cameras see, because one shows no motion along its rays. Innovations count in deviations of the detections'
        own noise: the errors of cameras that the filter counts as noise are the same in all frame sets.

        Args:
            prediction: of all robots, by the declared densities.
            observations: of a frame set, linearized about that prediction; it does not contradict the rig: else
                innovations show no motion.
        """
        estimator, states, dt = self._estimator, prediction.states, prediction.motion.dt
        stays = np.exp(-dt / PHASE_S)[:, None]
        before = stays * self.probabilities + (1 - stays) / len(SHARES)
        camera = observations.camera
        self.probabilities, P, information, rows = _core.weigh_motions(
            states.bodies,
            states.P,
            prediction.information,
            dt,
            estimator.densities,
            estimator.single,
            observations.centres,
            observations.body,
            camera,
            estimator.cameras.error_px[camera] ** 2 / observations.matched.detections.variance_px2,
            before,
            SHARES,
        )
        risen = (self.probabilities[rows] - before[rows]) @ np.log(SHARES)
        self.is_sudden = bool(2 * np.sum(risen > -np.log(SHARES[1])) > len(rows))
        return Prediction(replace(states, P=P), information, prediction.motion)
