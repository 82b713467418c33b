# SPDX-License-Identifier: BSD-3-Clause
"""Finds constellations whose markers are not at their declared positions: lost, glued elsewhere, or mismeasured.

The residuals of such a robot are large in every frame set and for every camera that sees the marker. What only one
camera shows is a fault of that camera: of its pose, its clock, or roundels that are not there.
"""

import logging

import numpy as np

from camera_node.arrays import Array, Mask

MISFIT_PX = 1.0  # RMS residual; a good calibration has 0.1 to 0.5
MAX_PX = 3.0  # larger residuals count as this: a few frame sets with a wrong clock blame no robot
MEMORY = 60  # frame sets of the running mean
MIN_CAMERAS = 2  # that show the residual
log = logging.getLogger("fusion")


class GeometryCheck:
    """Running mean of the squared residual that at least `MIN_CAMERAS` cameras show, for each robot.

    Args:
        names: of the robots.
        single: (N,) robots with a single marker, which have no geometry.
    """

    def __init__(self, names: tuple[str, ...], single: Mask) -> None:
        self._names, self._single = names, single
        self._mean_px2, self._count = np.zeros(len(names)), np.zeros(len(names), int)
        self._reported: set[str] = set()

    def note(self, mean_px2: Array) -> None:
        """Add the mean squared residuals (N, C) of a frame set by robot and camera, px^2; NaN where not observed."""
        known = np.isfinite(mean_px2)
        seen = (known.sum(1) >= MIN_CAMERAS) & ~self._single
        if not seen.any():
            return
        largest_first = -np.sort(-np.where(known[seen], mean_px2[seen], -np.inf), axis=1)
        shown_px2 = np.minimum(largest_first[:, MIN_CAMERAS - 1], MAX_PX**2)
        self._count[seen] += 1
        share = 1 / np.minimum(self._count[seen], MEMORY)
        self._mean_px2[seen] += share * (shown_px2 - self._mean_px2[seen])

    def misfits(self) -> dict[str, float]:
        """RMS residuals, pixels, of the robots above `MISFIT_PX`; logs each robot when it first appears."""
        rows = np.flatnonzero((self._count >= MEMORY) & (self._mean_px2 > MISFIT_PX**2))
        found = {self._names[k]: float(np.sqrt(self._mean_px2[k])) for k in rows}
        for name in found.keys() - self._reported:
            log.warning(
                "robot %s: its markers are %.1f px away from their positions in robots.yaml; "
                "fasten a loose marker, or measure the robot again",
                name,
                found[name],
            )
        self._reported = set(found)
        return found
