# SPDX-License-Identifier: BSD-3-Clause
"""Detects frame sets with unusual residuals, and the camera that causes them.

A slightly moved camera keeps its detections within their gates but biases the robots. Where the residuals of a frame
set rise, the tracker leaves out each camera in turn. The camera at fault is the one without which observations and
predictions of all robots agree: of residuals alone, those of the last two or three cameras always fall, because
position and velocity of a robot adapt to them.
"""

import numpy as np

from camera_node.foundation.arrays import Array
from fusion._core import SLACK_PX

MIN_RESIDUALS = 12  # in a frame set
MIN_PX, MIN_RATIO = 0.2, 2.0  # of an unusual median residual: absolute, and relative to the usual one
SLACK_RATIO = 3.0  # of the largest calibration errors to the usual residual
LEARNED = 15  # frame sets that define the usual residual
CAUCHY, REJECTED = (
    4.0,
    100.0,
)  # scale of the cost, standard deviations; square that a rejected observation has


class ResidualMonitor:
    """The usual residual of a frame set."""

    def __init__(self) -> None:
        self._usual_px, self._learned = 0.0, 0

    @property
    def slack_px(self) -> float:
        """Standard deviation that covers calibration errors: as the residuals show, `SLACK_PX` until they are known."""
        return min(SLACK_PX, SLACK_RATIO * self._usual_px) if self._learned >= LEARNED else SLACK_PX

    def is_unusual(self, squared_px: Array) -> bool:
        """Whether the squared residuals (N,) of a frame set, px^2, are far above the usual ones; learns others."""
        if len(squared_px) < MIN_RESIDUALS:
            return False
        median_px = _median_px(squared_px)
        if self._learned >= LEARNED and median_px > max(MIN_PX, MIN_RATIO * self._usual_px):
            return True
        self._learn(median_px)
        return False

    def learn(self, squared_px: Array) -> None:
        """Count the squared residuals (N,) of a frame set, px^2, as usual."""
        if len(squared_px) >= MIN_RESIDUALS:
            self._learn(_median_px(squared_px))

    def _learn(self, median_px: float) -> None:
        self._learned += 1
        self._usual_px += (median_px - self._usual_px) / min(self._learned, LEARNED)


def camera_at_fault(cost: float, without: dict[int, float]) -> int | None:
    """The camera without which the cost of a frame set falls, far below that without any other; None without one.

    Args:
        cost: with all cameras, as by `cost_of`.
        without: the cost without each camera, by its index.
    """
    if len(without) < 2:
        return None
    best, second = sorted(without, key=lambda k: without[k])[:2]
    return best if without[best] < min(cost, without[second]) / MIN_RATIO else None


def cost_of(squared: Array, n_rejected: int, corrections: Array, information: Array) -> float:
    """The robust cost of an update: observations and predictions.

    Args:
        squared: (N,) squared residuals in standard deviations; infinite where not visible.
        n_rejected: observations of robots that these contradict.
        corrections: (R, 12) of the predicted states.
        information: (R, 12, 12) of the predictions.
    """
    bounded = np.append(np.minimum(squared, REJECTED), np.full(n_rejected, REJECTED))
    observed = CAUCHY**2 * np.log1p(bounded / CAUCHY**2).sum()
    return float(observed + np.einsum("ri,rij,rj->", corrections, information, corrections))


def _median_px(squared_px: Array) -> float:
    """The median residual of the visible detections; NaN without any."""
    known = squared_px[np.isfinite(squared_px)]
    return float(np.sqrt(np.median(known))) if len(known) else np.nan
