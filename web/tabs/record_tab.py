# SPDX-License-Identifier: BSD-3-Clause
"""The tab Record: records the arena, lists recordings, exports one, and shows one in the place of the arena, with
pause, position, speed, and the part that is saved."""

import threading
from collections.abc import Callable
from datetime import datetime
from pathlib import Path
from typing import Any

import viser

from calib.rig.recording import RecordingWriter
from camera_node.foundation.errors import ConfigError
from fusion.recordings.arena_recording import NO_ROBOTS, ArenaRecorder
from fusion.recordings.recording_files import (
    RecordingSummary,
    list_recordings,
    recording_path,
    remove_recording,
    rename_recording,
)
from web.commands import run_program
from web.errors import WebError
from web.html_tables import Column, HtmlTable, TableRow
from web.own_control import OwnControl
from web.state.feed import ArenaState
from web.state.recording_player import RecordingPlayer
from web.state.subscription import Subscription
from web.widgets import ActionButton, Answer, ConfirmedButton, LongAction, set_content, set_property

LIST_INTERVAL = 9  # updates from one look at the folder to the next: about 3 s
NO_RECORDING = "no recording yet"
NAME_HINT = "of the file; empty for date and time"
RECORDING_COLUMNS = (
    Column("recording"),
    Column(
        "length", "s", "unknown while it is written, and after a power failure; fusion repair restores it"
    ),
    Column("size", "MB"),
    Column("cameras"),
    Column("robots"),
)

SPEEDS = ("0.25", "0.5", "1", "2", "4", "8")
STEP_S = 1 / 30  # of the button Step


class Recorder:
    """Records the arena into a new file of a folder; `roundel record` does so without a page."""

    def __init__(self, server: viser.ViserServer, tab: Any, subscription: Subscription, folder: Path) -> None:
        gui = server.gui
        self._subscription, self._folder = subscription, folder
        self._lock = threading.Lock()
        self._written: tuple[RecordingWriter, ArenaRecorder] | None = None
        self._name = OwnControl(server, tab, lambda gui: gui.add_text("Name", "", hint=NAME_HINT))
        self._answer = Answer(gui)
        self.action = LongAction(gui, ("Start recording", "Stop recording"), self._record, self._answer)

    @property
    def written(self) -> Path | None:
        """The file that is being written; None for none."""
        written = self._written
        return written[0].path if written is not None else None

    def update(self, state: ArenaState) -> None:
        """Show the progress."""
        self.action.show(enabled=state.server_alive)
        with self._lock:  # so that the outcome is shown last
            if self._written is not None:
                self._answer.show(_describe("recording", *self._written), "warn")

    def close(self) -> None:
        """Complete the recording."""
        self.action.close()

    def _record(self, end: threading.Event) -> str:
        """Record until `end`; returns the outcome. Raises ConfigError if the file exists or can't be written."""
        path = recording_path(
            self._folder, self._name.here.value or datetime.now().strftime("%Y-%m-%d_%H-%M-%S")
        )
        self._folder.mkdir(parents=True, exist_ok=True)
        if path.exists():
            raise ConfigError(f"{path} exists; give another name")
        with RecordingWriter(path, overwrite=False) as writer:
            arena = self._subscription.feed.keys.arena
            recorder = ArenaRecorder(self._subscription.connection, arena, writer)
            self._written = writer, recorder
            try:
                recorder.run(end)
            finally:
                with self._lock:
                    self._written = None
        return _describe("recorded", writer, recorder)


def _describe(verb: str, writer: RecordingWriter, recorder: ArenaRecorder) -> str:
    without = f"; {NO_ROBOTS}" if recorder.robots == frozenset() else ""
    return f"{verb} {writer.path}: {sum(dict(writer.counts).values())} messages{without}"


class RecordingList:
    """The recordings of a folder; the selected one can be played in the place of the arena, exported, renamed, deleted.

    Args:
        server: of the page.
        folder: the folder.
        show: plays a recording in the page, or shows the arena again for None.
        recorder: which may be writing one of them.
    """

    def __init__(
        self,
        server: viser.ViserServer,
        folder: Path,
        show: Callable[[Path | None], None],
        recorder: Recorder,
    ) -> None:
        gui = server.gui
        self._folder, self._show, self._recorder = folder, show, recorder
        self._updates, self._is_any = 0, False
        self._shown: Path | None = None
        place = gui.add_folder("Recordings")
        with place:
            self._table = gui.add_html("")
            self._selected = OwnControl(
                server, place, lambda gui: gui.add_dropdown("Recording", [NO_RECORDING])
            )
            answer = Answer(gui)
            self._replay = ActionButton(gui, "Replay", self.replay, answer)
            self._live = ActionButton(gui, "Back to the arena", self.back, answer)
            hint = "fuses the recording again and writes poses as CSV beside it"
            self._export = ActionButton(gui, "Export poses", self.export, answer, hint)
            self._new_name = OwnControl(server, place, lambda gui: gui.add_text("New file name", ""))
            self._rename = ActionButton(gui, "Rename the recording", self.rename, answer)
            self._delete = ConfirmedButton(
                gui,
                "Delete the recording",
                lambda: self._selected.chosen,
                self.delete,
                answer,
                " for good",
                "for good, with the second click",
            )

    def update(self, state: ArenaState) -> None:
        """Look at the folder every few seconds."""
        if self._updates % LIST_INTERVAL == 0:
            self._list()
        self._updates += 1
        for button in (self._replay, self._export, self._rename, self._delete):
            button.show(enabled=self._is_any)
        self._live.show(enabled=self._shown is not None, primary=self._shown is not None)

    def replay(self) -> str:
        """Play the selected recording."""
        self._show(self._path)
        self._shown = self._path
        return f"the page shows {self._path.name}"

    def back(self) -> str:
        """Show the arena."""
        self._show(None)
        self._shown = None
        return "the page shows the arena"

    def export(self) -> str:
        """Write the poses of the selected recording as CSV."""
        out = self._path.with_suffix(".csv")
        run_program("fusion", "replay", self._path, "--out", out)
        return f"wrote {out}"

    def rename(self) -> str:
        """Give the selected recording another name."""
        old = self._release()
        new = rename_recording(old, str(self._new_name.here.value).strip())
        self._new_name.here.value = ""
        self._list()
        self._selected.here.value = new.name
        return f"{old.name} is called {new.name} from now on"

    def delete(self) -> str:
        """Delete the selected recording."""
        path = self._release()
        remove_recording(path)
        self._list()
        return f"{path.name} is deleted"

    def _release(self) -> Path:
        """The selected recording, which is no longer played. Raises WebError while it is written."""
        path = self._path
        if path == self._recorder.written:
            raise WebError(f"{path.name} is being recorded; stop the recording first")
        if path == self._shown:
            self.back()
        return path

    def _list(self) -> None:
        found = list_recordings(self._folder)
        set_content(self._table, tabulate_recordings(found).html())
        self._is_any = bool(found)
        self._selected.offer([summary.path.name for summary in found], NO_RECORDING)

    @property
    def _path(self) -> Path:
        """The selected recording; a browser may send any text, and only recordings of the folder are used."""
        name = self._selected.chosen
        if name not in self._selected.here.options or name == NO_RECORDING:
            raise ConfigError("no recording of this name is in the folder; select one of the list")
        return self._folder / name


def tabulate_recordings(found: list[RecordingSummary]) -> HtmlTable:
    """One row for each recording."""
    rows = [
        TableRow(
            (
                summary.path.name,
                "–" if summary.seconds is None else f"{summary.seconds:.1f}",
                f"{summary.size_bytes / 1e6:.1f}",
                str(len(summary.cameras)),
                str(len(summary.robots)),
            ),
            "warn" if summary.seconds is None else "ok",
        )
        for summary in found
    ]
    return HtmlTable(RECORDING_COLUMNS, rows, "no recording in this folder yet")


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
        self._button.on_click(self.pause)
        step.on_click(self.step)
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

    def pause(self, _: object) -> None:
        """Pause, or play."""
        self._with(lambda player: player.play(not player.playing))

    def step(self, _: object) -> None:
        """Show the next frame."""
        self._with(lambda player: player.step(STEP_S))

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
