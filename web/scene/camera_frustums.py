# SPDX-License-Identifier: BSD-3-Clause
"""Draws calibrated cameras as frustums that show their live pictures."""

import math
from typing import Any

import viser

from calib.rig.camera import Camera
from calib.rig.rig import Rig
from camera_node.geometry.pose import wxyz_from_rotation
from web.colours import CAMERA

FRUSTUM_SCALE = 0.25
LABEL_ABOVE_M = 0.12  # in the image's upward direction
LABEL_SCALE = 0.8


class CameraDrawing:
    """The frustums of a rig's cameras with their names, below one node of the scene.

    Args:
        scene: the scene.
        root: name of that node.
        colour: of the frustums, displayed.
    """

    def __init__(
        self, scene: viser.SceneApi, root: str = "/cameras", colour: tuple[int, int, int] = CAMERA
    ) -> None:
        self._scene, self._root, self._colour = scene, root, colour
        self._rig: Rig | None = None
        self._drawn: dict[str, Camera] = {}
        self._frustums: dict[str, viser.CameraFrustumHandle] = {}
        self._labels: dict[str, viser.LabelHandle] = {}

    def draw(self, rig: Rig | None) -> None:
        """Draw the placed cameras of a rig; None removes them."""
        if rig is self._rig:
            return
        self._rig = rig
        placed = rig.placed() if rig else {}
        for name, camera in self._drawn.copy().items():
            if name not in placed or _shape(placed[name]) != _shape(camera):
                self._remove(name)
        for name, camera in placed.items():
            if name not in self._drawn:
                self._add(name, camera)
            elif camera != self._drawn[name]:  # moved: a node that is removed and added again loses its label
                self._move(name, camera)

    def show_picture(self, name: str, jpeg: bytes | None) -> None:
        """Show a live picture in a camera's frustum; None shows none."""
        if name in self._frustums:
            show_jpeg(self._frustums[name], jpeg)

    def _remove(self, name: str) -> None:
        del self._drawn[name]
        self._labels.pop(name).remove()
        self._frustums.pop(name).remove()

    def _move(self, name: str, camera: Camera) -> None:
        T, frustum = camera.matrix(), self._frustums[name]
        frustum.wxyz, frustum.position = wxyz_from_rotation(T[:3, :3]), T[:3, 3]
        self._drawn[name] = camera

    def _add(self, name: str, camera: Camera) -> None:
        T = camera.matrix()
        self._drawn[name] = camera
        self._frustums[name] = self._scene.add_camera_frustum(
            f"{self._root}/{name}",
            fov=_shape(camera)[0],
            aspect=_shape(camera)[1],
            scale=FRUSTUM_SCALE,
            thickness=0.01,
            color=self._colour,
            format="jpeg",
            wxyz=wxyz_from_rotation(T[:3, :3]),
            position=T[:3, 3],
        )
        self._labels[name] = self._scene.add_label(
            f"{self._root}/{name}/name",
            name,
            position=(0.0, -LABEL_ABOVE_M, 0.0),
            anchor="bottom-center",
            font_screen_scale=LABEL_SCALE,
        )


def _shape(camera: Camera) -> tuple[float, float]:
    """Vertical field of view, radians, and width over height of a camera's frustum."""
    angle = 2 * math.atan(camera.height / (2 * camera.fy))
    return angle, camera.width * camera.fy / (camera.height * camera.fx)


def show_jpeg(handle: Any, jpeg: bytes | None) -> None:
    """Show a JPEG that is not decoded here: Viser's own setter takes pixels and would encode them again."""
    name = "_image_data" if hasattr(handle, "_image_data") else "_data"
    if getattr(handle, name) is not jpeg:
        setattr(handle, name, jpeg)
