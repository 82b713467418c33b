# SPDX-License-Identifier: BSD-3-Clause
"""The page: a Viser server that draws the state of an arena thirty times a second."""

import math
import os
import socket
import threading
import time
from typing import Any, Protocol

import numpy as np
import viser

from calib.rig.rig import Rig
from camera_node.service import ServiceManager
from web.drawing import MarkerCloud, RobotDrawing, TruePoints, add_lights, draw_camera
from web.errors import PortError, WebError
from web.feed import ArenaState, Feed
from web.page_access import PageAccess, current_role, guarding
from web.panel import Panel

PERIOD_S = 1 / 30
TRAIL_INTERVAL = 3  # drawings from one update of the trails to the next
PANEL_INTERVAL = 15  # drawings from one update of the panel to the next
FIELD_OF_VIEW = math.radians(42)
DISTANCE = 2.3  # of the initial viewpoint, in radii of the rig
MIN_RADIUS_M = 1.5
DIRECTION = np.array([-0.45, 0.78, -0.43])  # in which the initial view looks
READ_ONLY = "**Read only**: the controls have no effect. Open the operator's address to change anything."
PANEL_SHIFT = 0.11  # of the initial view to the right, in distances: the panel covers the right of the page


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
        with guarding(access):
            self.server = viser.ViserServer(
                host=access.host, port=access.port, label="Roundel", verbose=False
            )
        self.server.on_client_connect(_describe_role)
        self.server.gui.configure_theme(
            dark_mode=True, control_width="large", show_logo=False, show_share_button=False
        )
        self._sections: list[PanelSection] = [Panel(self.server, self.reset_view)]
        self._drawings = 0
        self._rig: Rig | None = None
        self._cameras: list[Any] = []
        self._robots = RobotDrawing(self.server.scene)
        self._markers = MarkerCloud(self.server.scene)
        self.true_points = TruePoints(self.server.scene)
        add_lights(self.server.scene)
        _add_floor(self.server.scene)
        self.server.initial_camera.fov = FIELD_OF_VIEW
        self.reset_view()

    def run(self, stop: threading.Event) -> None:
        """Draw until `stop` is set; late drawings are skipped. Each drawing is progress of the service."""
        with ServiceManager() as service:
            service.ready()
            service.report(f"the page is at {self.access.address}")
            self._draw_until(stop, service)

    def _draw_until(self, stop: threading.Event, service: ServiceManager) -> None:
        due = time.monotonic()
        while not stop.wait(max(0.0, due - time.monotonic())):
            due = max(due + PERIOD_S, time.monotonic())
            service.progress()
            try:
                self.update()
            except Exception as error:  # a drawing that fails must not end the view
                self.feed.count_fault(f"drawing: {error!r}"[:120])

    def close(self) -> None:
        """Close the page and free its port."""
        self.server.stop()

    def update(self) -> None:
        """Draw the current state."""
        state = self.feed.state()
        with self.server.atomic():
            if state.rig is not self._rig:
                self._draw_rig(state.rig)
            self._robots.draw(state, trails=self._drawings % TRAIL_INTERVAL == 0)
            self._markers.draw(state)
            self.true_points.draw(state)
            if self._drawings % PANEL_INTERVAL == 0:
                for section in self._sections:
                    section.update(state)
        self._drawings += 1

    def add(self, section: PanelSection) -> None:
        """Update further controls of the panel together with the others."""
        self._sections.append(section)

    def reset_view(self) -> None:
        """Show the whole arena in all browsers, present and future."""
        position, target = default_viewpoint(self._rig)
        self.server.initial_camera.position = position
        self.server.initial_camera.look_at = target
        for client in self.server.get_clients().values():
            client.camera.position = position
            client.camera.look_at = target

    def _draw_rig(self, rig: Rig | None) -> None:
        for handle in self._cameras:
            handle.remove()
        first, self._rig, self._cameras = self._rig is None, rig, []
        for name, camera in (rig.placed() if rig else {}).items():
            self._cameras += draw_camera(self.server.scene, name, camera)
        if first:
            self.reset_view()


async def _describe_role(client: viser.ClientHandle) -> None:
    """Show a viewer why the controls do nothing. Viser runs it in the context of the browser's connection."""
    if current_role.get() == "viewer":
        client.gui.add_markdown(READ_ONLY, order=-1)


def _add_floor(scene: viser.SceneApi) -> None:
    scene.add_grid(
        "/floor",
        width=12.0,
        height=12.0,
        cell_color=(46, 49, 56),
        section_color=(72, 77, 88),
        fade_distance=14.0,
        fade_strength=2.0,
        fade_from="origin",
    )


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


def default_viewpoint(
    rig: Rig | None,
) -> tuple[tuple[float, float, float], tuple[float, float, float]]:
    """Return a position and a target, metres, from which the whole rig is visible."""
    centres = [camera.matrix()[:3, 3] for camera in (rig.placed() if rig else {}).values()]
    low, high = (np.min(centres, 0), np.max(centres, 0)) if centres else (np.full(3, -2.0), np.full(3, 2.0))
    distance = DISTANCE * max(MIN_RADIUS_M, float(np.linalg.norm(high - low)) / 2)
    target = np.array([*(low + high)[:2] / 2, 0.45 * high[2]])
    target += PANEL_SHIFT * distance * np.cross(DIRECTION, [0.0, 0.0, 1.0])
    return tuple((target - distance * DIRECTION).tolist()), tuple(target.tolist())
