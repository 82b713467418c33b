# SPDX-License-Identifier: BSD-3-Clause
"""The controls of a recording that the page plays: pause, position, speed, and the part that is saved."""

from collections.abc import Callable
from datetime import datetime

import viser

from web.commands import run_program
from web.errors import WebError
from web.state.feed import ArenaState
from web.state.replay import RecordingPlayer
from web.widgets import ActionButton, Answer, set_content, set_property

SPEEDS = ("0.25", "0.5", "1", "2", "4", "8")
STEP_S = 1 / 30  # of the button Step


class ReplayControls:
    """Pauses a recording, steps through it, and sets its position and speed.

    Attributes:
        player: the recording that is played; None hides the controls.
    """

    def __init__(self, gui: viser.GuiApi, player: RecordingPlayer | None = None) -> None:
        self.player = player
        self._folder = gui.add_folder("Replay", visible=player is not None)
        with self._folder:
            self._time = gui.add_markdown("")
            self._button = gui.add_button("Pause")
            self._position = gui.add_slider("Seconds", 0.0, 1.0, step=0.1, initial_value=0.0)
            self._speed = gui.add_dropdown("Speed", SPEEDS, initial_value="1")
            self._loop = gui.add_checkbox("Loop", False, hint="start again at the end")
            self._part = gui.add_multi_slider(
                "Part, s",
                0.0,
                1.0,
                step=0.1,
                initial_value=(0.0, 1.0),
                hint="only this part is played and saved",
            )
            step = gui.add_button("Step", hint="one frame of 30 Hz, paused")
            answer = Answer(gui)
            self._save = ActionButton(
                gui, "Save the part as a recording", self.save_part, answer, "beside the recording"
            )
        self._button.on_click(lambda _: self._with(lambda player: player.play(not player.playing)))
        step.on_click(lambda _: self._with(lambda player: player.step(STEP_S)))
        self._speed.on_update(lambda _: self._with(lambda player: player.set_speed(float(self._speed.value))))
        self._position.on_update(self._seek)
        self._part.on_update(self._select_part)

    def update(self, state: ArenaState) -> None:
        """Show the position and the time of day, and label the button with its action."""
        player = self.player
        set_property(self._folder, "visible", player is not None)
        if player is None:
            return
        if self._loop.value and not player.playing and player.seconds() >= player.part_s[1]:
            player.play()
        seconds = player.seconds()
        time_of_day = datetime.fromtimestamp(player.start_s + seconds).isoformat(" ", "milliseconds")
        set_content(self._time, time_of_day)
        set_property(self._button, "label", "Pause" if player.playing else "Play")
        duration_s = max(0.1, round(player.duration_s, 1))
        set_property(self._position, "max", duration_s)
        set_property(self._part, "max", duration_s)
        set_property(self._part, "value", tuple(round(s, 1) for s in player.part_s))
        self._save.show(enabled=player.part_s != (0.0, player.duration_s))
        set_property(self._position, "value", round(min(seconds, player.duration_s), 1))

    def save_part(self) -> str:
        """Write the part that is played as a recording of its own, beside the recording.

        Raises:
            WebError: it can't be written; the message is that of `roundel trim`.
        """
        player = self.player
        if player is None:
            raise WebError("no recording is played; select one and replay it")
        from_s, to_s = player.part_s
        out = player.path.with_name(f"{player.path.stem}_{from_s:.1f}-{to_s:.1f}s.mcap")
        run_program("fusion", "trim", player.path, out, "--from-s", from_s, "--to-s", to_s)
        return f"wrote {out}"

    def _select_part(self, event: viser.GuiEvent) -> None:
        if event.client is not None:
            from_s, to_s = (float(s) for s in self._part.value)
            self._with(lambda player: player.select_part(from_s, to_s))

    def _seek(self, event: viser.GuiEvent) -> None:
        if event.client is not None:  # a user moved the slider; `update` moves it without a client
            self._with(lambda player: player.seek(float(self._position.value)))

    def _with(self, act: Callable[[RecordingPlayer], None]) -> None:
        if self.player is not None:
            act(self.player)
