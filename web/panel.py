# SPDX-License-Identifier: BSD-3-Clause
"""The panel beside the view: how cameras, robots and server do, and coverage before calibration."""

from collections.abc import Callable
from typing import Any

import viser

from web.coverage import montage
from web.feed import Latest
from web.tables import describe_latency, describe_server, list_faults, tabulate_cameras, tabulate_robots


class Panel:
    """What is known of the arena, updated twice a second."""

    def __init__(self, server: viser.ViserServer, frame_arena: Callable[[], None]) -> None:
        gui = server.gui
        self._progress = gui.add_markdown("", visible=False)
        self._bar = gui.add_progress_bar(0.0, visible=False)
        self._server = gui.add_markdown("")
        self._latency = gui.add_markdown("")
        gui.add_button("Frame the arena").on_click(lambda _: frame_arena())
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

    def update(self, latest: Latest) -> None:
        """Show what is known now."""
        self._show_progress(latest)
        faults = list_faults(latest)
        self._skipped.visible = bool(faults.rows)
        write(self._server, describe_server(latest))
        write(self._latency, describe_latency(latest))
        write(self._robots, tabulate_robots(latest).html())
        write(self._cameras, tabulate_cameras(latest).html())
        write(self._faults, faults.html())
        self._show_coverage(latest)

    def _show_progress(self, latest: Latest) -> None:
        progress = latest.progress.message if latest.progress and latest.age(latest.progress) < 5.0 else None
        self._progress.visible = progress is not None
        self._bar.visible = progress is not None and 0.0 < progress.share < 1.0
        if progress is not None:
            write(self._progress, plain(progress.text))
            self._bar.value = 100.0 * progress.share

    def _show_coverage(self, latest: Latest) -> None:
        """Small pictures, until the cameras are placed: then nobody waves a wand any more."""
        self._wave.visible = bool(latest.coverage) and not (latest.rig and latest.rig.placed())
        if not self._wave.visible:
            return
        self._coverage.image = montage(latest.coverage)


def write(handle: Any, text: str) -> None:
    """Change a control's text, where it is another: browsers are told of every change."""
    if handle.content != text:
        handle.content = text


def plain(text: str) -> str:
    """Text of the network, so that Markdown takes no letter of it for a sign."""
    return "".join(f"\\{c}" if c in "\\`*_{}[]()#+!|<>~$" else c for c in text)
