# SPDX-License-Identifier: BSD-3-Clause
"""The tab Calibrate: changes of the rig in force, which can be undone."""

import viser

from web.feed import ArenaState
from web.subscription import Subscription
from web.widgets import ActionButton, Answer


class RigHistory:
    """Undoes and redoes changes of the rig."""

    def __init__(self, gui: viser.GuiApi, subscription: Subscription) -> None:
        with gui.add_folder("Changes of the rig"):
            answer = Answer(gui)
            self._buttons = (
                ActionButton(gui, "Undo the last change", subscription.undo, answer),
                ActionButton(gui, "Redo", subscription.redo, answer),
            )

    def update(self, state: ArenaState) -> None:
        """Enable the buttons while there is a server."""
        for button in self._buttons:
            button.show(enabled=state.server_alive)
