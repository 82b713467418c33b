# SPDX-License-Identifier: BSD-3-Clause
"""Finds the detections of a robot that contradict its other detections and its prediction.

Association gates each detection alone: the prediction may be off by a centimetre, and the gates are as wide. But that
error is common to all markers of a robot. Once some detections determine it, the others must lie within noise and
calibration errors (joint compatibility: Neira and Tardos 2001). The one that the others contradict most is removed
until all agree (Baarda's data snooping, 1968). A robust kernel alone may converge to a minimum at wrong detections,
since noise of 0.1 px makes all detections outliers of a prediction that is 1 px off.
"""

import numpy as np

from camera_node.arrays import Array, Mask
from fusion.model.observations import MatchedObservations
from fusion.tracking.estimator import Estimator, Prediction

MAX_DEVIATION = 13.8  # chi-square with 2 degrees of freedom, one in a thousand, as the gates of association


def jointly_compatible(
    estimator: Estimator, prediction: Prediction, observations: MatchedObservations, slack_px: float
) -> Mask:
    """(N,) the observations that agree with the prediction and the other ones of their bodies.

    Args:
        estimator: of the bodies.
        prediction: of the bodies.
        observations: N of them, which the prediction shows.
        slack_px: standard deviation of calibration errors, in quadrature to the noise.
    """
    observations = estimator.with_time_errors(prediction.states, observations)
    A, nu = estimator.innovations(prediction.states, observations)
    cov = observations.detections.cov
    variance = (cov[0, 0] + cov[1, 1]) / 2
    share = np.sqrt(variance / (variance + slack_px**2))[:, None]
    A, nu = A.reshape(-1, 2, 12) * share[:, :, None], nu.reshape(-1, 2) * share
    compatible = np.ones(len(nu), bool)
    for body in np.unique(observations.discs.body).tolist():
        rows = np.flatnonzero(observations.discs.body == body)
        compatible[rows] = _compatible(A[rows], nu[rows], prediction.information[body])
    return compatible


def _compatible(A: Array, nu: Array, information: Array) -> Mask:
    """(N,) of one body, with whitened derivatives A (N, 2, 12), innovations nu (N, 2) and prior information."""
    used = np.ones(len(nu), bool)
    while used.any():
        J = A[used].reshape(-1, 12)
        covariance = np.linalg.inv(information + J.T @ J)
        deviation = nu - A @ (covariance @ (J.T @ nu[used].ravel()))
        explained = A @ covariance @ A.transpose(0, 2, 1)
        S = np.eye(2) - explained[used]  # of residuals: the others predict nu with S^-1 - I more variance
        d2 = np.einsum("ni,ni->n", deviation[used], np.linalg.solve(S, deviation[used][:, :, None])[:, :, 0])
        worst = int(np.argmax(d2))
        if d2[worst] <= MAX_DEVIATION:
            break
        used[np.flatnonzero(used)[worst]] = False
    return used
