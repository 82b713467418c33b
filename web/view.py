# SPDX-License-Identifier: BSD-3-Clause
"""The page: a Viser server that draws the state of an arena thirty times a second."""

import os
import socket
import threading
import time
from typing import Protocol

import viser

from calib.rig.rig import Rig
from camera_node.foundation.service import ServiceManager
from web.errors import PortError, WebError
from web.html_tables import READ_ONLY_STYLE
from web.page_access import PageAccess, current_role, guarding
from web.scene.camera_frustums import CameraDrawing
from web.scene.markers import MarkerCloud, MarkerDiscs, RelativeFrames, TruePoints
from web.scene.robot_drawing import RobotDrawing
from web.scene.surroundings import add_floor, add_lights
from web.scene.viewpoint import Viewpoints
from web.state.feed import ArenaState, Feed

PERIOD_S = 1 / 30
SLOW_INTERVAL = 3  # drawings from one update of trails and labels to the next
PANEL_INTERVAL = 10  # drawings from one update of the panel to the next
READ_ONLY = "**Read only**: the controls have no effect. Open the operator's address to change anything."


class PanelSection(Protocol):
    """Controls of the panel."""

    def update(self, state: ArenaState) -> None:
        """Show the state."""


class View:
    """The page that browsers show. `update` draws once; `run` draws until it is stopped."""

    def __init__(self, feed: Feed, access: PageAccess) -> None:
        """Serve the page at the address of `access`, to the visitors whom it admits.

        Raises:
            WebError: the port is not available.
        """
        check_port(access.host, access.port)
        self.feed, self.access = feed, access
        self.shown = feed  # in the scene and the tables: the arena's, or that of a recording
        with guarding(access):
            self.server = viser.ViserServer(
                host=access.host, port=access.port, label="Roundel", verbose=False
            )
        self.server.on_client_connect(_describe_role)
        self.server.gui.configure_theme(
            dark_mode=True, control_width="large", show_logo=False, show_share_button=False
        )
        self._sections: list[tuple[PanelSection, bool, int]] = []
        self._drawings = 0
        self._rig: Rig | None = None
        self.cameras = CameraDrawing(self.server.scene)
        self.robots = RobotDrawing(self.server.scene)
        self._markers = MarkerCloud(self.server.scene)
        self.discs = MarkerDiscs(self.server.scene)
        self.true_points = TruePoints(self.server.scene)
        self._relative = RelativeFrames(self.server.scene)
        add_lights(self.server.scene)
        add_floor(self.server.scene)
        self._viewpoints = Viewpoints(self.server)

    def run(self, stop: threading.Event) -> None:
        """Draw until `stop` is set, at most half of the time. Each drawing is progress of the service."""
        with ServiceManager() as service:
            service.ready()
            service.report(f"the page is at {self.access.address}")
            self._draw_until(stop, service)

    def _draw_until(self, stop: threading.Event, service: ServiceManager) -> None:
        # Where the machine is slow, as much time passes before the next drawing: for clicks and for what is sent.
        begun = ended = time.monotonic()
        while not stop.wait(max(begun + PERIOD_S, 2 * ended - begun) - time.monotonic()):
            begun = time.monotonic()
            service.progress()
            try:
                self.update()
            except Exception as error:  # a drawing that fails must not end the view
                self.feed.count_fault(f"drawing: {error!r}"[:120])
            ended = time.monotonic()

    def close(self) -> None:
        """Close the page and free its port."""
        self.server.stop()

    def update(self) -> None:
        """Draw the current state."""
        live = self.feed.state()
        state = live if self.shown is self.feed else self.shown.state()
        with self.server.atomic():  # Viser sends nothing within the block, so it must be short
            if state.rig is not self._rig:
                self._draw_rig(state.rig)
            self.robots.draw(state, is_slow=self._drawings % SLOW_INTERVAL == 0)
            self._markers.draw(state)
            self.discs.draw(state)
            self.true_points.draw(state)
            self._relative.draw(state)
        for section, is_live, interval in self._sections:
            if self._drawings % interval == 0:
                self._update(section, live if is_live else state)
        self._drawings += 1

    def _update(self, section: PanelSection, state: ArenaState) -> None:
        try:
            section.update(state)
        except Exception as error:  # of one section: the buttons of the others must follow the arena
            self.feed.count_fault(f"{type(section).__name__}: {error!r}"[:120])

    def add(self, section: PanelSection, is_live: bool = False, interval: int = PANEL_INTERVAL) -> None:
        """Update further controls of the panel in one of `interval` drawings.

        Live ones act on the arena, also while a recording is shown.
        """
        self._sections.append((section, is_live, interval))

    def reset_view(self) -> None:
        """Show the whole arena in all browsers, present and future."""
        self._viewpoints.reset(self._rig)

    def _draw_rig(self, rig: Rig | None) -> None:
        first, self._rig = self._rig is None, rig
        self.cameras.draw(rig)
        if first:
            self.reset_view()


async def _describe_role(client: viser.ClientHandle) -> None:
    """Dim a viewer's controls, and say why they do nothing. Viser runs it in the context of the connection."""
    if current_role.get() == "viewer":
        client.gui.add_markdown(READ_ONLY, order=-1)
        client.gui.add_html(READ_ONLY_STYLE)


def check_port(host: str, port: int) -> None:
    """Raise WebError unless the port is available; Viser itself would silently use the next free one."""
    if not 0 < port < 65536:
        raise WebError(f"{port} is not a port; choose one from 1 to 65535 with --port")
    try:
        with socket.create_server((host, port)):
            pass
    except OSError as error:
        reason = os.strerror(error.errno) if error.errno and error.errno > 0 else error
        raise PortError(
            f"cannot serve the page on {host}:{port} ({reason}); choose another port with --port"
        ) from None
