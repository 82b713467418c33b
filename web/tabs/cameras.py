# SPDX-License-Identifier: BSD-3-Clause
"""The tab Cameras: what each camera does and sees."""

import cv2
import numpy as np
import viser
from numpy.typing import NDArray

from camera_node.errors import NetworkError
from web.coverage_picture import montage
from web.feed import ArenaState
from web.subscription import REQUEST_TIMEOUT_S, Subscription
from web.tables import tabulate_cameras
from web.widgets import ActionButton, Answer, set_content, set_property

NO_CAMERA = "no camera yet"


class CameraTable:
    """One row for each camera, and until the cameras are calibrated, where each has seen roundels."""

    def __init__(self, gui: viser.GuiApi) -> None:
        self._table = gui.add_html("")
        self._coverage_folder = gui.add_folder("Wand coverage", visible=False)
        with self._coverage_folder:
            self._coverage = gui.add_image(montage({}))

    def update(self, state: ArenaState) -> None:
        """Show the state."""
        set_content(self._table, tabulate_cameras(state).html())
        calibrated = state.rig is not None and bool(state.rig.placed())
        set_property(self._coverage_folder, "visible", bool(state.coverage) and not calibrated)
        if self._coverage_folder.visible:
            self._coverage.image = montage(state.coverage)


class SnapshotControls:
    """Requests the current image of a camera, in full resolution."""

    def __init__(self, gui: viser.GuiApi, subscription: Subscription) -> None:
        self._gui, self._subscription = gui, subscription
        self._folder = gui.add_folder("One camera")
        with self._folder:
            self._camera = gui.add_dropdown("Camera", [NO_CAMERA])
            answer = Answer(gui)
            self._button = ActionButton(gui, "Take a snapshot", self._show_snapshot, answer)
            self._image: viser.GuiImageHandle | None = None

    def update(self, state: ArenaState) -> None:
        """Offer the cameras that publish."""
        names = tuple(sorted(state.cameras)) or (NO_CAMERA,)
        if names != tuple(self._camera.options):
            self._camera.options = names
        self._button.show(enabled=bool(state.cameras))

    def _show_snapshot(self) -> str:
        name = str(self._camera.value)
        image = decode_jpeg(self._subscription.snapshot(name))
        if image is None:
            raise NetworkError(f"{name} sent no image within {REQUEST_TIMEOUT_S:.0f} s")
        if self._image is not None:
            self._image.remove()
        with self._folder:
            self._image = self._gui.add_image(image, format="jpeg")
        return f"{name}, {image.shape[1]} x {image.shape[0]}"


def decode_jpeg(data: bytes | None) -> NDArray[np.uint8] | None:
    """Decode a JPEG to (h, w, 3) RGB; return None for anything else."""
    if not data:
        return None
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
    except cv2.error:
        return None
    return None if image is None else np.ascontiguousarray(image[..., ::-1], np.uint8)
