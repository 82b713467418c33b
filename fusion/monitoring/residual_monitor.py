# SPDX-License-Identifier: BSD-3-Clause
"""Detects frame sets that contradict the predictions of the robots, and the camera that causes it.

A camera that turns by a third of a degree keeps its detections within their gates, and a fit may follow it: frames of
different times explain an offset of an image by a velocity. But then the fit is far from its prediction. So the cost of
a fit counts both, and is chi-square if all claims hold (Bar-Shalom et al. 2001, section 5.4).
"""

import math
from collections.abc import Mapping

import numpy as np
from scipy.special import chdtri  # the inverse survival function of chi-square

from camera_node.foundation.arrays import Array, Index
from fusion._core import SLACK_PX
from fusion.rig_graph.hypotheses import RIVAL

MIN_RATIO = 2.0  # of an unusual residual to the usual one
SLACK_RATIO = 3.0  # of the largest calibration errors to the usual residual
LEARNED = 15  # frame sets that define what is usual
REJOINED = 0.01  # probability with which detections that agree are left out once more
POSE_ERRORS = 6  # of a body, which detections determine first
FALSE_ALARM = 1e-6  # probability of a larger cost: once in ten hours of 30 frame sets a second


class ResidualMonitor:
    """The usual residual of a frame set, and the usual cost of its fit."""

    def __init__(self) -> None:
        self._usual_px, self._learned = 0.0, 0
        self._usual_cost = 1.0  # of an equation of the median robot: 1 if the claims hold

    @property
    def slack_px(self) -> float:
        """Standard deviation that covers calibration errors: as the residuals show, `SLACK_PX` until they are known."""
        return min(SLACK_PX, SLACK_RATIO * self._usual_px) if self.is_known else SLACK_PX

    @property
    def is_known(self) -> bool:
        """Whether enough frame sets were usual to define it."""
        return self._learned >= LEARNED

    def is_unusual(self, cost: Array, count: Index) -> bool:
        """Whether most robots contradict their predictions by more than chance and more than usual.

        Args:
            cost: (R,) of the fit of each robot, as of `BodyFit`.
            count: (R,) of its detections.
        """
        n = 2 * int(count.sum())
        if not self.is_known or not n:
            return False
        limit = max(float(chdtri(n, FALSE_ALARM)) / n, MIN_RATIO**2 * self._usual_cost)
        return bool(_mean_cost(cost, count) > limit)

    def is_explained(self, cost: float, count: int) -> bool:
        """Whether detections of a camera agree with a fit without them.

        Args:
            cost: what they add to the cost of the fit.
            count: of these detections; they show nothing if they have no more equations than a pose has errors.
        """
        allowed = chdtri(2 * count, REJOINED) * max(1.0, self._usual_cost)
        return 2 * count > POSE_ERRORS and bool(cost < allowed)

    def learn(self, squared_px: Array, cost: Array, count: Index) -> None:
        """Count a frame set as usual: the squared residuals (N,) of its detections, px^2, and its costs."""
        if not len(squared_px):
            return
        self._learned += 1
        share = 1 / min(self._learned, LEARNED)
        self._usual_px += share * (_median_px(squared_px) - self._usual_px)
        self._usual_cost += share * (_mean_cost(cost, count) - self._usual_cost)


def camera_at_fault(cost: float, without: Mapping[int, float]) -> int | None:
    """The camera without which the cost of a frame set falls, far below that without any other; None without one.

    Of two cameras each explains the robots alone: only their predictions show which one is at fault, if they do.

    Args:
        cost: with all cameras.
        without: the cost without each camera, by its index.
    """
    if len(without) < 2:
        return None
    best, second = sorted(without, key=lambda k: without[k])[:2]
    rival = min(cost, without[second])
    return best if without[best] < min(rival / MIN_RATIO, rival - chdtri(2, RIVAL)) else None


def _mean_cost(cost: Array, count: Index) -> float:
    """The cost of an equation of the median robot: 1 if the claims hold."""
    seen = count > 0
    return _median(cost[seen] / (2 * count[seen]))


def _median_px(squared_px: Array) -> float:
    """The median residual of the visible detections; NaN without any."""
    known = squared_px[np.isfinite(squared_px)]
    return math.sqrt(_median(known)) if len(known) else np.nan


def _median(values: Array) -> float:
    """Of at least one finite value; `np.median` takes 30 us for any number."""
    low, high = (len(values) - 1) // 2, len(values) // 2
    ordered = np.partition(values, (low, high))
    return float(ordered[low] + ordered[high]) / 2
