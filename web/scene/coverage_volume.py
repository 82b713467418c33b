# SPDX-License-Identifier: BSD-3-Clause
"""The volume that the calibrated cameras see: points coloured by the number of cameras that would detect a roundel."""

import threading
from collections.abc import Callable

import numpy as np
import viser

from calib.plan.planner import DIAMETER_M, PlannedArena, plan_around
from calib.rig.rig import Rig
from camera_node.foundation.arrays import Array, Index
from web.scene.markers import add_points
from web.state.feed import ArenaState

POINTS = 2500  # of the volume, about
HIGHEST_M = 2.0
POINT_M = 0.03
SINGLE, PAIR, MANY = (200, 120, 40), (150, 190, 60), (60, 200, 120)  # one camera, two, three or more


class CoverageVolume:
    """A check box, and the points while it is ticked. The points are computed in a thread for each new rig.

    Args:
        server: of the page; the check box is added to the tab in whose `with` block this is created.
        count_fault: called with what went wrong.

    Attributes:
        box: the check box.
        cloud: the points.
    """

    def __init__(self, server: viser.ViserServer, count_fault: Callable[[str], None]) -> None:
        self._count_fault = count_fault
        self.box = server.gui.add_checkbox(
            "Show what the cameras see",
            False,
            hint=f"places of level roundels of {DIAMETER_M:g} m: orange for one camera, yellow for two, green for more",
        )
        self.cloud = add_points(server.scene, "/coverage", MANY, POINT_M)
        self._rig: Rig | None = None
        self._volume: tuple[Rig, Array, Index] | None = None  # set by the thread, as one object

    def update(self, state: ArenaState) -> None:
        """Start the computation for a new rig, or draw its result."""
        wanted = self.box.value and state.rig is not None
        if wanted and state.rig is not self._rig:
            self._rig = state.rig
            threading.Thread(target=self._compute, args=(state.rig,), name="coverage", daemon=True).start()
        volume, self._volume = self._volume, None
        if volume is not None and volume[0] is self._rig:
            _, points, count = volume
            self.cloud.points = points.astype(np.float32)
            self.cloud.colors = colours(count)
        self.cloud.visible = bool(wanted and len(self.cloud.points) > 1)

    def _compute(self, rig: Rig) -> None:
        try:
            self._volume = (rig, *covered_points(rig))
        except Exception as error:  # a rig that can't be evaluated must not end the page
            self._count_fault(f"coverage: {error!r}"[:120])


def covered_points(rig: Rig) -> tuple[Array, Index]:
    """Points (N, 3) under the placed cameras of a rig which one of them sees, and the numbers of cameras (N,)."""
    cameras = rig.placed()
    if not cameras:
        return np.empty((0, 3)), np.empty(0, np.intp)
    plan = plan_around(cameras, HIGHEST_M)
    points = plan.volume(POINTS).points
    count = PlannedArena.of_rig(cameras, plan).errors_at(points).cameras
    return points[count > 0], count[count > 0]


def colours(count: Index) -> np.ndarray:
    """(N, 3) colours, uint8, by the number of cameras (N,), at least 1."""
    return np.array([SINGLE, PAIR, MANY], np.uint8)[np.minimum(count, 3) - 1]
