# SPDX-License-Identifier: BSD-3-Clause
"""Draws markers and the demo's true positions as point clouds."""

from typing import Any

import numpy as np
import viser

from web.colours import LABELED, TRUE_POINT, UNLABELED
from web.feed import ArenaState

MARKERS_S = 0.5  # markers disappear after so long without a message
TRUE_POINTS_S = 1.0  # true positions disappear after so long without a message


class MarkerCloud:
    """All markers as one point cloud: white if a robot has the marker, grey if it is unlabeled."""

    def __init__(self, scene: viser.SceneApi) -> None:
        self._cloud = scene.add_point_cloud(
            "/markers",
            np.zeros((1, 3), np.float32),
            np.zeros((1, 3), np.uint8),
            point_size=0.035,
            point_shape="circle",
            precision="float32",
            visible=False,
        )

    def draw(self, state: ArenaState) -> None:
        """Draw the latest markers, if they are recent."""
        timed = state.markers
        recent = timed is not None and state.age_s(timed) < MARKERS_S
        points = timed.message.positions() if timed is not None and recent else np.empty((0, 3))
        self._cloud.visible = len(points) > 0
        if timed is not None and len(points):
            labeled = timed.message.robot_index() >= 0
            self._cloud.points = points.astype(np.float32)
            self._cloud.colors = np.where(labeled[:, None], LABELED, UNLABELED).astype(np.uint8)


class TruePoints:
    """The demo's true marker positions, one point cloud per simulated object."""

    def __init__(self, scene: viser.SceneApi) -> None:
        self.scene = scene
        self.clouds: dict[str, Any] = {}

    def draw(self, state: ArenaState) -> None:
        """Draw the positions in the demo's latest message, if it is recent."""
        recent = state.progress and state.age_s(state.progress) < TRUE_POINTS_S
        objects = state.progress.message.true_points if state.progress and recent else {}
        for name in self.clouds.keys() - objects.keys():
            self.clouds.pop(name).remove()
        for name, points in objects.items():
            points = np.array(points, np.float32).reshape(-1, 3)
            if name in self.clouds:
                self.clouds[name].points = points
            elif len(points):
                self.clouds[name] = self.scene.add_point_cloud(
                    f"/true/{name}",
                    points,
                    TRUE_POINT,
                    point_size=0.05,
                    point_shape="circle",
                    precision="float32",
                )
