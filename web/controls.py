# SPDX-License-Identifier: BSD-3-Clause
"""What a person can ask of a running arena: a camera's picture, and a corrected camera put back."""

from typing import Any

import cv2
import numpy as np
import viser
from numpy.typing import NDArray

from web.feed import Latest
from web.panel import plain, write
from web.subscription import ASK_S, Subscription

NO_CAMERA = "no camera yet"


class LiveControls:
    """Buttons whose answers stand below them."""

    def __init__(self, server: viser.ViserServer, subscription: Subscription) -> None:
        self.server, self.subscription = server, subscription
        gui = server.gui
        self._look = gui.add_folder("Look")
        with self._look:
            self._camera = gui.add_dropdown("Camera", [NO_CAMERA])
            gui.add_button("Take its picture").on_click(lambda _: self.take_picture())
            self._answer = gui.add_markdown("")
            self._picture: Any = None
        with gui.add_folder("Moved cameras"):
            undo = gui.add_button("Undo the last correction")
            undo.on_click(lambda _: write(self._undone, plain(self.subscription.undo())))
            self._undone = gui.add_markdown("")

    def update(self, latest: Latest) -> None:
        """Offer the cameras that there are now."""
        names = tuple(sorted(latest.cameras)) or (NO_CAMERA,)
        if names != tuple(self._camera.options):
            self._camera.options = names

    def take_picture(self) -> None:
        """Ask the chosen camera for what it sees now, and show it."""
        name = str(self._camera.value)
        image = decode_jpeg(self.subscription.snapshot(name) if name != NO_CAMERA else None)
        if image is None:
            write(self._answer, plain(f"{name} sent no picture within {ASK_S:.0f} s"))
            return
        write(self._answer, plain(f"{name}, {image.shape[1]} x {image.shape[0]}"))
        if self._picture is not None:
            self._picture.remove()
        with self._look:
            self._picture = self.server.gui.add_image(image)


def decode_jpeg(data: bytes | None) -> NDArray[np.uint8] | None:
    """(h, w, 3) RGB of a JPEG's bytes, or None where they are none."""
    if not data:
        return None
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
    except cv2.error:
        return None
    return None if image is None else np.ascontiguousarray(image[..., ::-1], np.uint8)
