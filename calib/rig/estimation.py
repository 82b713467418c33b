# SPDX-License-Identifier: BSD-3-Clause
"""What all estimates of calibration share: false-alarm rates, and robust statistics of residuals.

Residuals of pixels are distances in the image. Where both coordinates are normal, a distance follows a Rayleigh
distribution, whose median is (2 log 2)^1/2 standard deviations of one coordinate.
"""

import numpy as np
from numpy.typing import ArrayLike

from camera_node.foundation.arrays import Array

CHANCE = 1e-4  # probability of a false alarm of a test, over all that it tries
CLEAR = 3.0  # standard deviations, from which a single figure differs
GROSS = 4.5  # standard deviations of a distance in the image: one true one in 25,000 is beyond
# Least difference of the squared Mahalanobis distances of two hypotheses, one of which is chosen: odds of 400.
MARGIN = 12.0
CAUCHY_SCALE = 2.3849  # standard deviations, of Cauchy's kernel: 95 % efficient on normal residuals
MEDIAN_DEVIATION = 0.6745  # standard deviations of a normal distribution: half of it is nearer to its mean
STEPS = 10  # of Gauss-Newton at the most: from a start nearby, each doubles the number of right digits


def coordinate_sigma(distances: Array) -> float:
    """Robust standard deviation of one coordinate, from distances (n,) in the image."""
    return float(np.median(distances)) / float(np.sqrt(2 * np.log(2)))


def rms(values: ArrayLike) -> float:
    """Root mean square of values (n,); NaN of none."""
    values = np.asarray(values, float)
    return float(np.sqrt((values**2).mean())) if len(values) else float("nan")


def cauchy_cost(squares: Array, scale: float) -> float:
    """Sum of squared residuals (n,) under Cauchy's kernel; plain where `scale` is infinite."""
    return float(squares.sum() if np.isinf(scale) else (scale**2 * np.log1p(squares / scale**2)).sum())


def cauchy_weights(distances: Array, scale: float) -> Array:
    """(n,) weights of residuals of these sizes in reweighted least squares under Cauchy's kernel."""
    return 1 / (1 + (distances / scale) ** 2)
