# SPDX-License-Identifier: BSD-3-Clause
"""Finds constellations whose markers are not at their declared positions: lost, glued elsewhere, or mismeasured.

The residuals of such a robot are large in every frame set, also where the cameras agree about all other robots.
"""

import logging

import numpy as np

from camera_node.arrays import Array, Mask

MISFIT_PX = 1.0  # RMS residual; a good calibration has 0.1 to 0.5
MAX_PX = 3.0  # larger residuals count as this: a few frame sets with a wrong clock blame no robot
MEMORY = 60  # frame sets of the running mean
log = logging.getLogger("fusion")


class GeometryCheck:
    """Running mean squared residual of each robot.

    Args:
        names: of the robots.
        single: (N,) robots with a single marker, which have no geometry.
    """

    def __init__(self, names: tuple[str, ...], single: Mask) -> None:
        self._names, self._single = names, single
        self._mean_px2, self._count = np.zeros(len(names)), np.zeros(len(names), int)
        self._reported: set[str] = set()

    def note(self, residual_px: Array) -> None:
        """Add the RMS residuals (N,) of a frame set, pixels; NaN for robots without observations."""
        seen = np.isfinite(residual_px) & ~self._single
        self._count[seen] += 1
        share = 1 / np.minimum(self._count[seen], MEMORY)
        squared_px2 = np.minimum(residual_px[seen], MAX_PX) ** 2
        self._mean_px2[seen] += share * (squared_px2 - self._mean_px2[seen])

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
