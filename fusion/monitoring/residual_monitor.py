# SPDX-License-Identifier: BSD-3-Clause
"""Detects frame sets with unusual residuals, and the camera that causes them.

A slightly moved camera keeps its detections within their gates but biases the robots. Where the residuals of a frame
set rise, the tracker leaves out each camera in turn; the one without which they fall is the suspect.
"""

import numpy as np

from camera_node.arrays import Array

MIN_RESIDUALS = 12  # in a frame set
MIN_PX, MIN_RATIO = 0.2, 2.0  # of an unusual median residual: absolute, and relative to the usual one
LEARNED = 15  # frame sets that define the usual residual


class ResidualMonitor:
    """The usual residual of a frame set, and the last suspect."""

    def __init__(self) -> None:
        self._usual_px, self._learned, self._suspect = 0.0, 0, ""

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

    def suspects(self, names: tuple[str, ...]) -> list[str]:
        """All cameras, the last suspect first."""
        return sorted(names, key=lambda name: name != self._suspect)

    def confirms(self, name: str, without_px2: Array, with_px2: Array) -> bool:
        """Whether the residuals without this camera are far below those with it; it is then the last suspect."""
        if not len(without_px2) or np.nanmedian(without_px2) > np.nanmedian(with_px2) / MIN_RATIO**2:
            return False
        self._suspect = name
        return True


def _median_px(squared_px: Array) -> float:
    """The median residual of the visible detections; NaN without any."""
    known = squared_px[np.isfinite(squared_px)]
    return float(np.sqrt(np.median(known))) if len(known) else np.nan
