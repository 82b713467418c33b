# SPDX-License-Identifier: BSD-3-Clause
"""The tab Record: position and speed of a recording."""

import viser

from web.feed import ArenaState
from web.replay import RecordingPlayer

SPEEDS = ("0.25", "0.5", "1", "2", "4", "8")


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
