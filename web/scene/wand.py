# SPDX-License-Identifier: BSD-3-Clause
"""Draws the wand during a recording: its markers, the line through them, and the places where it was."""

import numpy as np
import viser
from numpy.typing import NDArray

from camera_node.foundation.arrays import Array
from web.colours import PREVIEW, WAND_TRAIL

MAX_TRAIL = 1500  # places; at five a second, a session of five minutes
MARKER_M, TRAIL_M, LINE_M = 0.05, 0.025, 0.02


class WandDrawing:
    """The wand in the scene; nothing before the first `draw`."""

    def __init__(self, scene: viser.SceneApi) -> None:
        self._scene = scene
        self._trail = np.empty((0, 3), np.float32)
        self._handles: dict[str, viser.SceneNodeHandle] = {}

    @property
    def n_places(self) -> int:
        """Number of places in the trail."""
        return len(self._trail)

    def clear(self) -> None:
        """Remove the wand and its trail."""
        self._trail = np.empty((0, 3), np.float32)
        for handle in self._handles.values():
            handle.remove()
        self._handles = {}

    def draw(self, markers: Array | None) -> None:
        """Draw the markers (M, 3), world, of which those that are NaN were not seen; None hides the wand."""
        points = np.empty((0, 3)) if markers is None else markers[np.isfinite(markers[:, 0])]
        for name in ("markers", "line"):
            if name in self._handles:
                self._handles.pop(name).remove()
        if not len(points):
            return
        points = np.asarray(points, np.float32)
        self._handles["markers"] = self._add_points("markers", points, PREVIEW, MARKER_M)
        if len(points) > 1:
            ends = points[[np.linalg.norm(points - points[0], axis=1).argmax(), 0]]
            self._handles["line"] = self._scene.add_line_segments(
                "/wand/line", ends[None], PREVIEW, thickness=LINE_M
            )
        trail = np.concatenate([self._trail, points.mean(axis=0, keepdims=True)])
        self._trail = np.asarray(trail[-MAX_TRAIL:], np.float32)
        self._handles["trail"] = self._add_points("trail", self._trail, WAND_TRAIL, TRAIL_M)

    def _add_points(
        self, name: str, points: NDArray[np.float32], colour: tuple[int, int, int], size_m: float
    ) -> viser.PointCloudHandle:
        return self._scene.add_point_cloud(
            f"/wand/{name}", points, colour, point_size=size_m, point_shape="circle", precision="float32"
        )
