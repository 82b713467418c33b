# SPDX-License-Identifier: BSD-3-Clause
"""Assembles the page of a running arena or of a recording: the header with the condition of the arena and the progress
of a long step, tabs and their controls."""

import contextlib
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import viser

from web.condition import assess
from web.html_tables import STYLE, Column, HtmlTable, TableRow, small, status_line
from web.scene.coverage_volume import CoverageVolume
from web.state.feed import ArenaState, Feed
from web.state.recording_player import RecordingPlayer
from web.state.subscription import Subscription
from web.tables import tabulate_robots
from web.tabs.calibration_panels import CalibrationFiles, RigHistoryPanel, calibration_in_force
from web.tabs.camera_tab import CameraSettings, CameraTable, LivePictures
from web.tabs.graph_panel import GraphPanel
from web.tabs.marker_picker import MarkerPicker
from web.tabs.record_tab import Recorder, RecordingList, ReplayControls
from web.tabs.robot_selection import RobotSelection
from web.tabs.robot_tab import RobotEditor
from web.tabs.ruler import Ruler
from web.tabs.status_tab import StatusTab
from web.tabs.wand_session import WandSessionPanel
from web.tabs.world_panel import WorldPanel
from web.view import View
from web.widgets import GREY, StateText, escape_markdown, set_content, set_property

TABS = ("Cameras", "Calibrate", "Robots", "Record", "Status")  # in the order of the work
PANEL_PX = 440
HELP = "?"
KEY_COLUMNS = (Column("key"), Column("action"))
PROGRESS_S = 5.0  # the demo's progress disappears after so long without a message


class Shortcuts:
    """The keys of a page; `?` shows them in the browser that asks. They do nothing while a text is typed."""

    def __init__(self, gui: viser.GuiApi) -> None:
        self._gui = gui
        self._rows: list[TableRow] = []
        # Viser's list of keys has letters only; it passes any other one to the browser, where ? comes with Shift.
        self.add(HELP, "Show the keys", self._show, modifier="shift")
        gui.add_html(small(f"{HELP} shows the keys, Ctrl+K searches for an action"))

    def add(
        self,
        key: Any,
        label: str,
        act: Callable[[viser.ClientHandle | None], object],
        modifier: Any = None,
    ) -> None:
        """Have a key call `act` with the browser in which it was pressed."""
        self._rows.append(TableRow((key, label), "ok"))
        command = self._gui.add_command(label, hotkey=key, modifier=modifier)

        @command.on_trigger
        def _(event: viser.CommandEvent) -> None:
            act(event.client)

    def _show(self, client: viser.ClientHandle | None) -> None:
        if client is None:
            return
        modal = client.gui.add_modal("Keys")
        with modal:
            client.gui.add_html(HtmlTable(KEY_COLUMNS, self._rows).html())
            client.gui.add_button("Close").on_click(lambda _: modal.close())


class Header:
    """The page's title, its status line and its tabs.

    Attributes:
        tabs: by the names in `TABS`; controls that are added in a `with` block of one are in that tab.
        keys: the keys of the page.
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
        self.keys = Shortcuts(gui)
        self.keys.add("V", "Show the whole arena", lambda _: reset_view())

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


def add_live_page(
    view: View,
    subscription: Subscription,
    endpoint: str,
    files: CalibrationFiles | None,
    closing: contextlib.ExitStack,
    folder: Path = Path(),
) -> None:
    """Add the controls of a running arena.

    Args:
        view: the page.
        subscription: connected to the arena.
        endpoint: of the arena's server.
        files: of the calibration with a wand; None for none.
        closing: ends what runs in the background.
        folder: where recordings and robots are saved.
    """
    header = Header(view.server, view.feed.keys.arena, endpoint, view.reset_view)
    gui = view.server.gui
    view.add(header)
    with header.tabs["Cameras"]:
        view.add(CameraTable(gui))
        view.add(CoverageVolume(view.server, view.feed.count_fault))
        pictures = LivePictures(view.server, subscription, view.cameras)
        closing.callback(pictures.close)
        view.add(pictures, is_live=True)
        settings = CameraSettings(view.server, subscription, files)
        closing.callback(settings.close)
        view.add(settings, is_live=True)
    with header.tabs["Calibrate"]:
        view.add(StateText(gui, calibration_in_force), is_live=True)
        if files is not None:
            panel = WandSessionPanel(view.server, subscription, files)
            view.add(panel, is_live=True)
            header.calibrating = panel.next_action
            closing.callback(panel.close)
            header.keys.add("W", "Start or end a wand session", panel.session.toggle)
            view.add(WorldPanel(view.server, subscription, files), is_live=True)
        view.add(RigHistoryPanel(gui, subscription), is_live=True)
    with header.tabs["Robots"]:
        selection = add_robots(view)
        editor = RobotEditor(view.server, subscription, folder, selection)
        view.add(editor, is_live=True)
        header.keys.add("U", "Undo the change of a robot", editor.undo_button.run)
        view.add(MarkerPicker(view.server, subscription), is_live=True)
        add_instruments(view, selection, header.keys)
    with header.tabs["Record"]:
        recorder = Recorder(view.server, header.tabs["Record"], subscription, folder)
        header.keys.add("R", "Start or stop recording", recorder.action.toggle)
        closing.callback(recorder.close)
        view.add(recorder, is_live=True)
        controls = add_replay_controls(view, header.keys)
        shown = ShownRecording(view, header, controls)
        closing.callback(shown.show, None)
        view.add(RecordingList(view.server, folder, shown.show, recorder), is_live=True)
    with header.tabs["Status"]:
        view.add(StatusTab(gui, endpoint, view.feed.keys.arena), is_live=True)


class ShownRecording:
    """Shows a recording in the page of a running arena, and the arena again."""

    def __init__(self, view: View, header: Header, controls: ReplayControls) -> None:
        self._view, self._header, self._controls = view, header, controls
        self._stop = threading.Event()

    def show(self, path: Path | None) -> None:
        """Play a recording; None shows the arena. Raises ConfigError if the file is no recording."""
        player = RecordingPlayer(path) if path is not None else None
        self._stop.set()  # ends the thread of the recording before
        if player is not None and path is not None:
            self._stop = threading.Event()
            self._view.shown = Feed(player.arena, clock=player.seconds)
            arguments = (self._view.shown, self._stop)
            threading.Thread(target=player.run, args=arguments, name="replay", daemon=True).start()
        else:
            self._view.shown = self._view.feed
        self._controls.player, self._header.recording = player, path.name if path else ""


def add_replay_page(view: View, player: RecordingPlayer) -> None:
    """Add the controls of a recording."""
    header = Header(view.server, player.arena, player.path.name, view.reset_view)
    gui = view.server.gui
    view.add(header)
    with header.tabs["Cameras"]:
        view.add(CameraTable(gui))
    with header.tabs["Robots"]:
        add_instruments(view, add_robots(view), header.keys)
    with header.tabs["Record"]:
        add_replay_controls(view, header.keys, player)
    with header.tabs["Status"]:
        view.add(StatusTab(gui, "", player.arena))


def add_robots(view: View) -> RobotSelection:
    """Add one row for each declared robot, and the selection of robots."""
    view.add(StateText(view.server.gui, lambda state: tabulate_robots(state).html()))
    selection = RobotSelection(view.server.gui)
    view.robots.is_shown = selection.is_shown
    view.add(selection)
    return selection


def add_instruments(view: View, selection: RobotSelection, keys: Shortcuts) -> Ruler:
    """Add what plots and measures, in the arena and in a recording."""
    ruler = Ruler(view.server)
    view.add(GraphPanel(view.server.gui, selection), interval=1)
    view.add(ruler, interval=1)
    keys.add("M", "Measure a distance, or stop measuring", ruler.toggle)
    return ruler


def add_replay_controls(view: View, keys: Shortcuts, player: RecordingPlayer | None = None) -> ReplayControls:
    """Add what pauses and moves a recording; hidden without one."""
    controls = ReplayControls(view.server.gui, player)
    view.add(controls)
    keys.add("P", "Pause or play the recording", controls.pause)
    keys.add("N", "Show the next frame of the recording", controls.step)
    return controls
