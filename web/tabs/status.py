# SPDX-License-Identifier: BSD-3-Clause
"""The tab Status: figures of the server, what it skipped, and what happened."""

import viser

from web.feed import ArenaState
from web.html_tables import small
from web.tables import describe_latency, describe_server, tabulate_faults
from web.widgets import set_content, set_property


class StatusTab:
    """Figures of the server, and faults."""

    def __init__(self, gui: viser.GuiApi) -> None:
        self._server = gui.add_html("")
        self._latency = gui.add_html("")
        self._fault_folder = gui.add_folder("Skipped messages", visible=False)
        with self._fault_folder:
            self._faults = gui.add_html("")

    def update(self, state: ArenaState) -> None:
        """Show the state."""
        set_content(self._server, small(describe_server(state)))
        set_content(self._latency, small(describe_latency(state)))
        faults = tabulate_faults(state)
        set_property(self._fault_folder, "visible", bool(faults.rows))
        set_content(self._faults, faults.html())
