# SPDX-License-Identifier: BSD-3-Clause
"""Assembles the page of a running arena or of a recording: header, tabs and their controls."""

import contextlib
import threading
from pathlib import Path

from web.scene.coverage import CoverageVolume
from web.state.feed import Feed
from web.state.replay import RecordingPlayer
from web.state.subscription import Subscription
from web.tabs.calibrate import CalibrationInForce, RigHistoryPanel
from web.tabs.cameras import CameraSettings, CameraTable, LivePictures
from web.tabs.header import Header
from web.tabs.marker_picker import MarkerPicker
from web.tabs.record import Recorder, RecordingList
from web.tabs.replay_controls import ReplayControls
from web.tabs.rig_change import CalibrationFiles
from web.tabs.robots import RobotEditor, RobotTable
from web.tabs.status import StatusTab
from web.tabs.wand_session import WandSessionPanel
from web.tabs.world import WorldPanel
from web.view import View


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
        view.add(CalibrationInForce(gui), is_live=True)
        if files is not None:
            panel = WandSessionPanel(view.server, subscription, files)
            view.add(panel, is_live=True)
            header.calibrating = panel.next_action
            closing.callback(panel.close)
            view.add(WorldPanel(view.server, subscription, files), is_live=True)
        view.add(RigHistoryPanel(gui, subscription), is_live=True)
    with header.tabs["Robots"]:
        view.add(RobotTable(gui))
        view.add(RobotEditor(gui, subscription, folder), is_live=True)
        view.add(MarkerPicker(view.server, subscription), is_live=True)
    with header.tabs["Record"]:
        recorder = Recorder(gui, subscription, folder)
        closing.callback(recorder.close)
        view.add(recorder, is_live=True)
        controls = ReplayControls(gui)
        shown = ShownRecording(view, header, controls)
        closing.callback(shown.show, None)
        view.add(RecordingList(gui, folder, shown.show, recorder), is_live=True)
        view.add(controls)
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
        view.add(RobotTable(gui))
    with header.tabs["Record"]:
        view.add(ReplayControls(gui, player))
    with header.tabs["Status"]:
        view.add(StatusTab(gui, "", player.arena))
