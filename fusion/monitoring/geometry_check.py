# SPDX-License-Identifier: BSD-3-Clause
"""Constellations whose markers do not stand as declared: one fell off, was glued on anew, or was measured wrongly.

Such a robot is seen by cameras that agree about all others, or that no camera left out makes agree; what remains of its
own detections is large in every instant, and is said with its name.
"""

import logging

import numpy as np

from camera_node.arrays import Array, Mask

MISFIT_PX = 1.0  # RMS of what remains: good cameras leave 0.1 to 0.5
MEMORY = 60  # instants over which it is averaged
log = logging.getLogger("fusion")


class GeometryCheck:
    """What remains of each robot's detections, over the last instants.

    Args:
        names: the robots.
        single: (N,) those of one marker, which have no shape.
    """

    def __init__(self, names: tuple[str, ...], single: Mask) -> None:
        self._names, self._single = names, single
        self._mean_px2, self._count = np.zeros(len(names)), np.zeros(len(names), int)
        self._told: set[str] = set()

    def note(self, residual_px: Array) -> None:
        """Take an instant's RMS (N,); NaN where a robot was not seen."""
        seen = np.isfinite(residual_px) & ~self._single
        self._count[seen] += 1
        share = 1 / np.minimum(self._count[seen], MEMORY)
        self._mean_px2[seen] += share * (residual_px[seen] ** 2 - self._mean_px2[seen])

    def misfits(self) -> dict[str, float]:
        """RMS in pixels of the robots that do not fit; each is said once when it begins."""
        rows = np.flatnonzero((self._count >= MEMORY) & (self._mean_px2 > MISFIT_PX**2))
        found = {self._names[k]: float(np.sqrt(self._mean_px2[k])) for k in rows}
        for name in found.keys() - self._told:
            log.warning(
                "robot %s: its markers miss the places in robots.yaml by %.1f px; one is loose or was measured wrongly",
                name,
                found[name],
            )
        self._told = set(found)
        return found
