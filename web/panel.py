# SPDX-License-Identifier: BSD-3-Clause
"""The panel beside the view: how cameras, robots and server do, coverage before calibration, a camera's picture."""

from collections.abc import Callable
from typing import Any

import cv2
import numpy as np
import viser
from numpy.typing import NDArray

from web.coverage import montage
from web.feed import Feed, Latest
from web.tables import describe_server, list_faults, tabulate_cameras, tabulate_robots

NO_CAMERA = "no camera yet"


class Panel:
    """Controls and tables, updated twice a second."""

    def __init__(self, server: viser.ViserServer, feed: Feed, frame_arena: Callable[[], None]) -> None:
        self.server, self.feed = server, feed
        gui = server.gui
        self._progress = gui.add_markdown("", visible=False)
        self._bar = gui.add_progress_bar(0.0, visible=False)
        self._server = gui.add_markdown("")
        with gui.add_folder("Robots"):
            self._robots = gui.add_html("")
        with gui.add_folder("Cameras"):
            self._cameras = gui.add_html("")
        self._skipped = gui.add_folder("Skipped", visible=False)
        with self._skipped:
            self._faults = gui.add_html("")
        self._wave = gui.add_folder("Where the wand was seen", visible=False)
        with self._wave:
            self._coverage = gui.add_image(montage({}))
        self._look = gui.add_folder("Look")
        with self._look:
            gui.add_button("Frame the arena").on_click(lambda _: frame_arena())
            self._camera = gui.add_dropdown("Camera", [NO_CAMERA])
            gui.add_button("Take its picture").on_click(lambda _: self.take_picture())
            self._answer = gui.add_markdown("")
            self._picture: Any = None

    def update(self, latest: Latest) -> None:
        """Show what is known now."""
        self._show_progress(latest)
        faults = list_faults(latest)
        self._skipped.visible = bool(faults.rows)
        _write(self._server, describe_server(latest))
        _write(self._robots, tabulate_robots(latest).html())
        _write(self._cameras, tabulate_cameras(latest).html())
        _write(self._faults, faults.html())
        self._show_coverage(latest)
        names = tuple(sorted(latest.cameras)) or (NO_CAMERA,)
        if names != tuple(self._camera.options):
            self._camera.options = names

    def take_picture(self) -> None:
        """Ask the chosen camera for what it sees now, and show it."""
        name = str(self._camera.value)
        image = decode_jpeg(self.feed.snapshot(name) if name != NO_CAMERA else None)
        if image is None:
            _write(self._answer, f"{name} sent no picture within 2 s")
            return
        _write(self._answer, f"{name}, {image.shape[1]} x {image.shape[0]}")
        if self._picture is not None:
            self._picture.remove()
        with self._look:
            self._picture = self.server.gui.add_image(image)

    def _show_progress(self, latest: Latest) -> None:
        progress = latest.progress.message if latest.progress and latest.progress.age() < 5.0 else None
        self._progress.visible = progress is not None
        self._bar.visible = progress is not None and 0.0 < progress.share < 1.0
        if progress is not None:
            _write(self._progress, _plain(progress.text))
            self._bar.value = 100.0 * progress.share

    def _show_coverage(self, latest: Latest) -> None:
        """Small pictures, until the cameras are placed: then nobody waves a wand any more."""
        self._wave.visible = bool(latest.coverage) and not (latest.rig and latest.rig.placed())
        if not self._wave.visible:
            return
        self._coverage.image = montage(latest.coverage)


def decode_jpeg(data: bytes | None) -> NDArray[np.uint8] | None:
    """(h, w, 3) RGB of a JPEG's bytes, or None where they are none."""
    if not data:
        return None
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
    except cv2.error:
        return None
    return None if image is None else np.ascontiguousarray(image[..., ::-1], np.uint8)


def _write(handle: Any, text: str) -> None:
    if handle.content != text:
        handle.content = text


def _plain(text: str) -> str:
    """Text of the network, so that Markdown takes no letter of it for a sign."""
    return "".join(f"\\{c}" if c in "\\`*_{}[]()#+!|<>~$" else c for c in text)
