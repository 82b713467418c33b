# SPDX-License-Identifier: BSD-3-Clause
"""The page's side panel: tables of robots and cameras, the server's state, faults and wand coverage."""

from collections.abc import Callable
from typing import Any

import viser

from web.coverage import montage
from web.feed import ArenaState
from web.tables import (
    describe_latency,
    describe_server,
    tabulate_cameras,
    tabulate_faults,
    tabulate_robots,
)

PROGRESS_S = 5.0  # the demo's status line disappears after so long without a message


class Panel:
    """The part of the panel that every page has."""

    def __init__(self, server: viser.ViserServer, reset_view: Callable[[], None]) -> None:
        """Add the controls; the button calls `reset_view`."""
        gui = server.gui
        self._progress = gui.add_markdown("", visible=False)
        self._bar = gui.add_progress_bar(0.0, visible=False)
        self._server = gui.add_markdown("")
        self._latency = gui.add_markdown("")
        gui.add_button("Show the whole arena").on_click(lambda _: reset_view())
        with gui.add_folder("Robots"):
            self._robots = gui.add_html("")
        with gui.add_folder("Cameras"):
            self._cameras = gui.add_html("")
        self._fault_folder = gui.add_folder("Faults", visible=False)
        with self._fault_folder:
            self._faults = gui.add_html("")
        self._coverage_folder = gui.add_folder("Wand coverage", visible=False)
        with self._coverage_folder:
            self._coverage = gui.add_image(montage({}))

    def update(self, state: ArenaState) -> None:
        """Show the state."""
        self._show_progress(state)
        faults = tabulate_faults(state)
        self._fault_folder.visible = bool(faults.rows)
        set_content(self._server, describe_server(state))
        set_content(self._latency, describe_latency(state))
        set_content(self._robots, tabulate_robots(state).html())
        set_content(self._cameras, tabulate_cameras(state).html())
        set_content(self._faults, faults.html())
        self._show_coverage(state)

    def _show_progress(self, state: ArenaState) -> None:
        recent = state.progress and state.age_s(state.progress) < PROGRESS_S
        progress = state.progress.message if state.progress and recent else None
        self._progress.visible = progress is not None
        self._bar.visible = progress is not None and 0.0 < progress.share < 1.0
        if progress is not None:
            set_content(self._progress, escape_markdown(progress.text))
            self._bar.value = 100.0 * progress.share

    def _show_coverage(self, state: ArenaState) -> None:
        """Show the pictures until the cameras are calibrated; they guide the wand session only."""
        calibrated = state.rig is not None and bool(state.rig.placed())
        self._coverage_folder.visible = bool(state.coverage) and not calibrated
        if self._coverage_folder.visible:
            self._coverage.image = montage(state.coverage)


def set_content(handle: Any, text: str) -> None:
    """Set a control's text if it differs: Viser sends every assignment to all browsers."""
    if handle.content != text:
        handle.content = text


def escape_markdown(text: str) -> str:
    """Escape text from the network so that Markdown shows it literally."""
    return "".join(f"\\{c}" if c in "\\`*_{}[]()#+!|<>~$" else c for c in text)
