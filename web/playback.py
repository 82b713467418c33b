# SPDX-License-Identifier: BSD-3-Clause
"""The controls of a replay: pause, pace and the moment."""

import viser

from web.feed import Latest
from web.replay import RecordingPlayer

SPEEDS = ("0.25", "0.5", "1", "2", "4", "8")


class ReplayControls:
    """A button, a slider over the recording, and the pace."""

    def __init__(self, server: viser.ViserServer, replay: RecordingPlayer) -> None:
        self.replay = replay
        gui = server.gui
        with gui.add_folder("RecordingPlayer"):
            self._button = gui.add_button("Pause")
            self._moment = gui.add_slider(
                "Seconds", 0.0, max(0.1, round(replay.duration_s, 1)), step=0.1, initial_value=0.0
            )
            self._speed = gui.add_dropdown("Speed", SPEEDS, initial_value="1")
        self._button.on_click(lambda _: replay.play(not replay.playing))
        self._speed.on_update(lambda _: replay.set_speed(float(self._speed.value)))
        self._moment.on_update(self._jump)

    def update(self, latest: Latest) -> None:
        """Show the moment, and what the button would do."""
        label = "Pause" if self.replay.playing else "Play"
        if self._button.label != label:
            self._button.label = label
        self._moment.value = round(min(latest.now, self.replay.duration_s), 1)

    def _jump(self, event: viser.GuiEvent) -> None:
        if event.client is not None:  # a person, not `update`
            self.replay.seek(float(self._moment.value))
