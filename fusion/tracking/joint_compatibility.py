# SPDX-License-Identifier: BSD-3-Clause
"""Finds the detections of a robot that contradict its other detections and its prediction.

Association gates each detection alone: the prediction may be off by a centimetre, and the gates are as wide. But that
error is common to all markers of a robot. Once some detections determine it, the others must lie within noise and
calibration errors (joint compatibility: Neira and Tardos 2001). The one that the others contradict most is removed
until all agree (Baarda's data snooping, 1968). A robust kernel alone may converge to a minimum at wrong detections,
since noise of 0.1 px makes all detections outliers of a prediction that is 1 px off.
"""

import numpy as np

from camera_node.foundation.arrays import Array, Mask
from fusion import _core
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
    order = np.argsort(observations.discs.body, kind="stable")
    bodies, first, count = np.unique(observations.discs.body[order], return_index=True, return_counts=True)
    row = np.repeat(np.arange(len(bodies)), count)
    at = row, np.arange(len(order)) - first[row]
    tables = np.zeros((len(bodies), int(count.max()), 2, 12)), np.zeros((len(bodies), int(count.max()), 2))
    tables[0][at], tables[1][at] = A[order], nu[order]
    compatible = np.ones(len(nu), bool)
    compatible[order] = _compatible(*tables, prediction.information[bodies])[at]
    return compatible


def _compatible(A: Array, nu: Array, information: Array) -> Mask:
    """(B, N) of B bodies: whitened derivatives A (B, N, 2, 12), innovations nu (B, N, 2) and prior information.

    Rows of zeros, which fill the table, are compatible.
    """
    used, bodies = np.ones(nu.shape[:2], bool), np.arange(len(nu))
    while len(bodies):
        rows = used[bodies][:, :, None]
        deviation = _deviations(A[bodies] * rows[..., None], nu[bodies] * rows, information[bodies])
        worst = np.argmax(deviation, 1)
        found = deviation[np.arange(len(bodies)), worst] > MAX_DEVIATION
        bodies, worst = bodies[found], worst[found]
        used[bodies, worst] = False
    return used


def _deviations(A: Array, nu: Array, information: Array) -> Array:
    """(B, N) squared deviations of each observation from the prediction and all others; 0 for rows of zeros."""
    J, shape = A.reshape(len(A), -1, 12), nu.shape
    CJ = J @ _core.inverses(information + J.transpose(0, 2, 1) @ J)
    solution = J.transpose(0, 2, 1) @ nu.reshape(len(A), -1, 1)
    u, v = np.moveaxis(nu - (CJ @ solution).reshape(shape), 2, 0)
    (Bu, Bv), (Au, Av) = np.moveaxis(CJ.reshape(A.shape), 2, 0), np.moveaxis(A, 2, 0)
    S_uu, S_vv, S_uv = 1 - (Bu * Au).sum(2), 1 - (Bv * Av).sum(2), -(Bu * Av).sum(2)  # of the residuals
    return (S_vv * u * u - 2 * S_uv * u * v + S_uu * v * v) / (S_uu * S_vv - S_uv**2)
