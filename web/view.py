# SPDX-License-Identifier: BSD-3-Clause
"""The live view: a Viser server that draws what a `Feed` knows, thirty times a second."""

import math
import os
import socket
import threading
import time
from typing import Any, Protocol

import numpy as np
import viser

from calib.rig.rig import Rig
from web.drawing import GHOST, MarkerCloud, RobotDrawing, draw_camera, light
from web.errors import WebError
from web.feed import Feed, Latest
from web.panel import Panel

PERIOD_S = 1 / 30
TRAIL_EVERY = 3  # frames
PANEL_EVERY = 15
FIELD_OF_VIEW, DISTANCE = math.radians(42), 2.3  # a long lens, from a distance of so many radii of the rig


class Part(Protocol):
    """Controls of the panel."""

    def update(self, latest: Latest) -> None:
        """Show what is known now."""


class View:
    """The page that browsers see. `update` draws one frame; `run` draws until it is told to stop."""

    def __init__(self, feed: Feed, host: str = "127.0.0.1", port: int = 8080) -> None:
        """Raises WebError where the port can't be had."""
        check_port(host, port)
        self.feed = feed
        self.server = viser.ViserServer(host=host, port=port, label="Roundel", verbose=False)
        self.server.gui.configure_theme(
            dark_mode=True, control_width="large", show_logo=False, show_share_button=False
        )
        self._parts: list[Part] = [Panel(self.server, self.frame_arena)]
        self._frames = 0
        self._rig: Rig | None = None
        self._cameras: list[Any] = []
        self._robots = RobotDrawing(self.server.scene)
        self._markers = MarkerCloud(self.server.scene)
        self.ghosts: dict[str, Any] = {}
        light(self.server.scene)
        self.server.scene.add_grid(
            "/floor",
            width=12.0,
            height=12.0,
            cell_color=(46, 49, 56),
            section_color=(72, 77, 88),
            fade_distance=14.0,
            fade_strength=2.0,
            fade_from="origin",
        )
        self.server.initial_camera.fov = FIELD_OF_VIEW
        self.frame_arena()

    @property
    def url(self) -> str:
        """Where a browser finds the page."""
        return f"http://{self.server.get_host()}:{self.server.get_port()}"

    def run(self, stop: threading.Event) -> None:
        """Draw until `stop` is set; late frames are left out, not caught up."""
        due = time.monotonic()
        while not stop.wait(max(0.0, due - time.monotonic())):
            due = max(due + PERIOD_S, time.monotonic())
            try:
                self.update()
            except Exception as error:  # one frame that can't be drawn must not end the view
                self.feed.count_fault(f"drawing: {error!r}"[:120])

    def close(self) -> None:
        """Close the page and free its port."""
        self.server.stop()

    def update(self) -> None:
        """Draw what is known now."""
        latest = self.feed.latest()
        with self.server.atomic():
            if latest.rig is not self._rig:
                self._draw_rig(latest.rig)
            self._robots.draw(latest, trails=self._frames % TRAIL_EVERY == 0)
            self._markers.draw(latest)
            self._draw_ghosts(latest)
            if self._frames % PANEL_EVERY == 0:
                for part in self._parts:
                    part.update(latest)
        self._frames += 1

    def add(self, part: Part) -> None:
        """More controls for the panel."""
        self._parts.append(part)

    def frame_arena(self) -> None:
        """Turn every browser's view, and that of those to come, to the whole arena."""
        position, target = frame(self._rig)
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
            self.frame_arena()

    def _draw_ghosts(self, latest: Latest) -> None:
        ghosts = (
            latest.progress.message.ghosts if latest.progress and latest.age(latest.progress) < 1.0 else {}
        )
        for name in self.ghosts.keys() - ghosts.keys():
            self.ghosts.pop(name).remove()
        for name, points in ghosts.items():
            points = np.array(points, np.float32).reshape(-1, 3)
            if name in self.ghosts:
                self.ghosts[name].points = points
            elif len(points):
                self.ghosts[name] = self.server.scene.add_point_cloud(
                    f"/ghosts/{name}",
                    points,
                    GHOST,
                    point_size=0.05,
                    point_shape="circle",
                    precision="float32",
                )


def check_port(host: str, port: int) -> None:
    """Raise WebError unless the port can be listened on; Viser itself would silently take the next free one."""
    if not 0 < port < 65536:
        raise WebError(f"{port} is no port; choose one from 1 to 65535 with --port")
    try:
        with socket.create_server((host, port)):
            pass
    except OSError as error:
        reason = os.strerror(error.errno) if error.errno and error.errno > 0 else error
        raise WebError(f"can't show a page on {host}:{port} ({reason}); choose another with --port") from None


def frame(rig: Rig | None) -> tuple[tuple[float, float, float], tuple[float, float, float]]:
    """From where to look, and at what, to have the whole rig in sight, metres."""
    centres = [camera.matrix()[:3, 3] for camera in (rig.placed() if rig else {}).values()]
    low, high = (np.min(centres, 0), np.max(centres, 0)) if centres else (np.full(3, -2.0), np.full(3, 2.0))
    reach = DISTANCE * max(1.5, float(np.linalg.norm(high - low)) / 2)
    ahead = np.array([-0.45, 0.78, -0.43])
    target = np.array([*(low + high)[:2] / 2, 0.45 * high[2]])
    right = np.cross(ahead, [0.0, 0.0, 1.0])
    target += 0.11 * reach * right  # the panel covers the right of the page
    return tuple((target - reach * ahead).tolist()), tuple(target.tolist())
