# SPDX-License-Identifier: BSD-3-Clause
"""The tab Robots: all declared robots with their state, and why a robot is not tracked."""

import viser

from web.feed import ArenaState
from web.tables import tabulate_robots
from web.widgets import set_content


class RobotTable:
    """One row for each declared robot."""

    def __init__(self, gui: viser.GuiApi) -> None:
        self._table = gui.add_html("")

    def update(self, state: ArenaState) -> None:
        """Show the state."""
        set_content(self._table, tabulate_robots(state).html())
