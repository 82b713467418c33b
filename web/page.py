# SPDX-License-Identifier: BSD-3-Clause
"""Assembles the page of a running arena or of a recording: header, tabs and their controls."""

import contextlib

from web.replay import RecordingPlayer
from web.subscription import Subscription
from web.tabs.calibrate import RigHistory
from web.tabs.cameras import CameraSettings, CameraTable, LivePictures
from web.tabs.header import Header
from web.tabs.marker_picker import MarkerPicker
from web.tabs.record import ReplayControls
from web.tabs.robots import RobotTable
from web.tabs.status import StatusTab
from web.tabs.wand_session import CalibrationFiles, WandSessionPanel
from web.view import View


def add_live_page(
    view: View,
    subscription: Subscription,
    endpoint: str,
    files: CalibrationFiles | None,
    closing: contextlib.ExitStack,
) -> None:
    """Add the controls of a running arena.

    Args:
        view: the page.
        subscription: connected to the arena.
        endpoint: of the arena's server.
        files: of the calibration with a wand; None for none.
        closing: ends what runs in the background.
    """
    header = Header(view.server, view.feed.keys.arena, endpoint, view.reset_view)
    gui = view.server.gui
    view.add(header)
    with header.tabs["Cameras"]:
        view.add(CameraTable(gui))
        pictures = LivePictures(view.server, subscription, view.cameras)
        closing.callback(pictures.close)
        view.add(pictures)
        view.add(CameraSettings(gui, subscription))
    with header.tabs["Calibrate"]:
        if files is not None:
            panel = WandSessionPanel(view.server, subscription, files)
            view.add(panel)
            closing.callback(panel.close)
        view.add(RigHistory(gui, subscription))
    with header.tabs["Robots"]:
        view.add(RobotTable(gui))
        view.add(MarkerPicker(view.server, subscription))
    with header.tabs["Status"]:
        view.add(StatusTab(gui))


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
        view.add(ReplayControls(view.server, player))
    with header.tabs["Status"]:
        view.add(StatusTab(gui))
