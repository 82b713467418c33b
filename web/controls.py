# SPDX-License-Identifier: BSD-3-Clause
"""The panel's controls: requests to a running arena, and the position and speed of a recording."""

from typing import Any

import cv2
import numpy as np
import viser
from numpy.typing import NDArray

from web.feed import ArenaState
from web.panel import escape_markdown, set_content
from web.replay import RecordingPlayer
from web.subscription import REQUEST_TIMEOUT_S, Subscription

NO_CAMERA = "no camera yet"
SPEEDS = ("0.25", "0.5", "1", "2", "4", "8")


class LiveControls:
    """Requests a camera's image, and undoes and redoes changes of the rig."""

    def __init__(self, server: viser.ViserServer, subscription: Subscription) -> None:
        self.server, self.subscription = server, subscription
        gui = server.gui
        self._image_folder = gui.add_folder("Camera image")
        with self._image_folder:
            self._camera = gui.add_dropdown("Camera", [NO_CAMERA])
            gui.add_button("Take a snapshot").on_click(lambda _: self.show_snapshot())
            self._answer = gui.add_markdown("")
            self._image: Any = None
        with gui.add_folder("Changes of the rig"):
            gui.add_button("Undo the last change").on_click(lambda _: self._show(subscription.undo()))
            gui.add_button("Redo").on_click(lambda _: self._show(subscription.redo()))
            self._outcome = gui.add_markdown("")

    def update(self, state: ArenaState) -> None:
        """Offer the cameras that publish."""
        names = tuple(sorted(state.cameras)) or (NO_CAMERA,)
        if names != tuple(self._camera.options):
            self._camera.options = names

    def _show(self, outcome: str) -> None:
        set_content(self._outcome, escape_markdown(outcome))

    def show_snapshot(self) -> None:
        """Request the current image of the selected camera and show it."""
        name = str(self._camera.value)
        image = decode_jpeg(self.subscription.snapshot(name) if name != NO_CAMERA else None)
        if image is None:
            text = f"{name} sent no image within {REQUEST_TIMEOUT_S:.0f} s"
            set_content(self._answer, escape_markdown(text))
            return
        set_content(self._answer, escape_markdown(f"{name}, {image.shape[1]} x {image.shape[0]}"))
        if self._image is not None:
            self._image.remove()
        with self._image_folder:
            self._image = self.server.gui.add_image(image)


class ReplayControls:
    """Pauses a recording, and sets its position and speed."""

    def __init__(self, server: viser.ViserServer, player: RecordingPlayer) -> None:
        self.player = player
        gui = server.gui
        end = max(0.1, round(player.duration_s, 1))
        with gui.add_folder("Recording"):
            self._button = gui.add_button("Pause")
            self._position = gui.add_slider("Seconds", 0.0, end, step=0.1, initial_value=0.0)
            self._speed = gui.add_dropdown("Speed", SPEEDS, initial_value="1")
        self._button.on_click(lambda _: player.play(not player.playing))
        self._speed.on_update(lambda _: player.set_speed(float(self._speed.value)))
        self._position.on_update(self._seek)

    def update(self, state: ArenaState) -> None:
        """Show the position, and label the button with its action."""
        label = "Pause" if self.player.playing else "Play"
        if self._button.label != label:
            self._button.label = label
        self._position.value = round(min(state.now_s, self.player.duration_s), 1)

    def _seek(self, event: viser.GuiEvent) -> None:
        if event.client is not None:  # a user moved the slider; `update` moves it without a client
            self.player.seek(float(self._position.value))


def decode_jpeg(data: bytes | None) -> NDArray[np.uint8] | None:
    """Decode a JPEG to (h, w, 3) RGB; return None for anything else."""
    if not data:
        return None
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
    except cv2.error:
        return None
    return None if image is None else np.ascontiguousarray(image[..., ::-1], np.uint8)
