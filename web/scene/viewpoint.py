# SPDX-License-Identifier: BSD-3-Clause
"""The viewpoint from which the whole arena is visible, in each browser by the shape of its scene."""

import math
from typing import Any

import numpy as np
import viser

from calib.rig.rig import Rig
from camera_node.foundation.arrays import Array

FIELD_OF_VIEW = math.radians(42)
MARGIN = 0.78  # share of half the picture in which the cameras are; the rest is for their frustums and names
SMALLEST_ROOM = np.array(
    [(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (0, 1)]
)  # from the target's foot
USUAL_ROOM = [(x, y, 2.0) for x in (-2, 2) for y in (-2, 2)]  # cameras of an arena without any
DIRECTION = np.array([-0.45, 0.78, -0.43])  # in which the initial view looks
_FORWARD = DIRECTION / np.linalg.norm(DIRECTION)
USUAL_ASPECT = 4 / 3  # width over height of a scene whose browser has not reported it
SAME_M = 0.01  # within which a viewpoint is the one that the page chose
N_CHOSEN = 4
SAME_ASPECT = 0.02  # relative


class Viewpoints:
    """Shows the whole arena in every browser, until its user moves the viewpoint; `reset` shows it again.

    A scene that gets another shape, as when the panel is folded or a telephone is turned, is fitted again.
    """

    def __init__(self, server: viser.ViserServer) -> None:
        self._server = server
        self._rig: Rig | None = None
        # By browser: its aspect, and the positions chosen last. A message may still report the one before.
        self._fitted: dict[int, tuple[float, list[Array]]] = {}
        server.initial_camera.fov = FIELD_OF_VIEW
        server.on_client_connect(self._follow)
        server.on_client_disconnect(self._forget)
        self.reset(None)

    def reset(self, rig: Rig | None) -> None:
        """Show the whole of a rig in all browsers, present and future."""
        self._rig = rig
        position, target = default_viewpoint(rig)
        self._server.initial_camera.position = position
        self._server.initial_camera.look_at = target
        for client in self._server.get_clients().values():
            self._fit(client)

    async def _follow(self, client: viser.ClientHandle) -> None:
        self._fit(client)

        @client.camera.on_update
        async def _(camera: Any) -> None:
            aspect, chosen = self._fitted.get(client.client_id, (math.nan, []))
            known = [self._server.initial_camera.position, *chosen]
            if not chosen or np.linalg.norm(camera.position - np.array(known), axis=1).min() > SAME_M:
                self._fitted.pop(client.client_id, None)  # its user moved
            elif abs(camera.aspect / aspect - 1) > SAME_ASPECT:
                self._fit(client)

    async def _forget(self, client: viser.ClientHandle) -> None:
        self._fitted.pop(client.client_id, None)

    def _fit(self, client: viser.ClientHandle) -> None:
        aspect = client.camera.aspect
        position, target = default_viewpoint(self._rig, aspect)
        chosen = self._fitted.get(client.client_id, (aspect, [client.camera.position]))[1]
        self._fitted[client.client_id] = aspect, [*chosen[1 - N_CHOSEN :], np.array(position)]
        with client.atomic():
            client.camera.position, client.camera.look_at = position, target


def default_viewpoint(
    rig: Rig | None, aspect: float = USUAL_ASPECT
) -> tuple[tuple[float, float, float], tuple[float, float, float]]:
    """The nearest position, and its target, metres, from which the whole rig and the floor below it are visible.

    Args:
        rig: the cameras that are placed count; None, or a rig without any, is a room of 4 m.
        aspect: width over height of the browser's scene.
    """
    placed = (rig.placed() if rig else {}).values()
    centres = np.array([camera.matrix()[:3, 3] for camera in placed] or USUAL_ROOM)
    low, high = centres.min(0), centres.max(0)
    target = np.array([*(low + high)[:2] / 2, 0.45 * high[2]])
    offsets = np.vstack([centres, centres * [1, 1, 0], target * [1, 1, 0] + SMALLEST_ROOM]) - target
    return tuple((target - _distance(offsets, aspect) * _FORWARD).tolist()), tuple(target.tolist())


def _distance(offsets: Array, aspect: float) -> float:
    """The least distance from the target at which all points at `offsets` (N, 3) from it are inside the margin."""
    right = np.cross(_FORWARD, (0.0, 0.0, 1.0))
    right /= np.linalg.norm(right)
    up = np.cross(right, _FORWARD)
    slope = MARGIN * math.tan(FIELD_OF_VIEW / 2)  # of the outermost rays; FIELD_OF_VIEW is the vertical one
    across = np.maximum(np.abs(offsets @ right) / aspect, np.abs(offsets @ up))
    return float(np.max(across / slope - offsets @ _FORWARD))
