# SPDX-License-Identifier: BSD-3-Clause
"""The top of the page: arena and endpoint, the condition of the arena, progress of a long step; and the tabs."""

from collections.abc import Callable

import viser

from web.condition import assess
from web.html_tables import STYLE, status_line
from web.state.feed import ArenaState
from web.widgets import GREY, escape_markdown, set_content, set_property

TABS = ("Cameras", "Calibrate", "Robots", "Record", "Status")  # in the order of the work
PANEL_PX = 440
PROGRESS_S = 5.0  # the demo's progress disappears after so long without a message


class Header:
    """The page's title, its status line and its tabs.

    Attributes:
        tabs: by the names in `TABS`; controls that are added in a `with` block of one are in that tab.
        recording: the name of the recording that is shown in the place of the arena; empty for none.
        calibrating: returns what to do next in a calibration that began on this page; empty for none.
    """

    def __init__(
        self, server: viser.ViserServer, arena: str, endpoint: str, reset_view: Callable[[], None]
    ) -> None:
        """Add the controls, at the side of the scene, so that they hide nothing.

        Args:
            server: of the page.
            arena: its name.
            endpoint: where the arena's server is expected, or the file of a recording.
            reset_view: shows the whole arena.
        """
        gui = server.gui
        self._endpoint = endpoint
        self.recording = ""
        self.calibrating: Callable[[], str] = str
        gui.main_panel.dock_right()
        gui.main_panel.set_width(PANEL_PX)
        gui.set_panel_label(f"Roundel: {arena} at {endpoint}")
        gui.add_html(STYLE)
        self._status = gui.add_html(status_line("wait", f"connecting to {endpoint} ..."))
        self._progress = gui.add_markdown("", visible=False)
        self._bar = gui.add_progress_bar(0.0, visible=False)
        group = gui.add_tab_group()
        self.tabs = {name: group.add_tab(name) for name in TABS}
        gui.add_button("Show the whole arena", color=GREY).on_click(lambda _: reset_view())

    def update(self, state: ArenaState) -> None:
        """Show the condition of the arena, and the progress of the demo if it is recent."""
        condition = assess(state, self._endpoint, self.calibrating())
        recorded = f"recording {self.recording}: " if self.recording else ""
        set_content(self._status, status_line(condition.level, recorded + condition.text))
        recent = state.progress and state.age_s(state.progress) < PROGRESS_S
        progress = state.progress.message if state.progress and recent else None
        set_property(self._progress, "visible", progress is not None)
        set_property(self._bar, "visible", progress is not None and 0.0 < progress.share < 1.0)
        if progress is not None:
            set_content(self._progress, escape_markdown(progress.text))
            set_property(self._bar, "value", 100.0 * progress.share)
