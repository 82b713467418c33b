# SPDX-License-Identifier: BSD-3-Clause
"""Measures the distance between two markers that are clicked in the scene."""

import numpy as np
import viser
from numpy.typing import ArrayLike

from camera_node.foundation.arrays import Array
from fusion.protocol.pose_messages import Markers
from web.colours import SELECTED, to_linear
from web.html_tables import small
from web.scene.clicks import nearest_to_ray
from web.state.feed import ArenaState
from web.tables import STALE_S
from web.widgets import GREY, set_content, set_property

MEASURE, STOP = "Measure a distance", "Stop measuring"
FOLLOW_M = 0.05  # that a marker may move from one drawing to the next
THICKNESS_M = 0.006


class Ruler:
    """The button "Measure a distance"; then two clicks on markers. The line follows them while they move."""

    def __init__(self, server: viser.ViserServer) -> None:
        self._ends: list[Array] = []  # positions (3,), world
        self._markers = np.empty((0, 3))
        self._active = False
        self._button = server.gui.add_button(MEASURE, color=GREY)
        self._answer = server.gui.add_html("")
        self._line = server.scene.add_line_segments(
            "/ruler",
            np.zeros((1, 2, 3), np.float32),
            tuple(to_linear(SELECTED).tolist()),
            thickness=THICKNESS_M,
            visible=False,
        )
        self._button.on_click(self.toggle)
        server.scene.on_click()(lambda click: self.select(click.ray_origin, click.ray_direction))

    def select(self, origin: ArrayLike, direction: ArrayLike) -> None:
        """Select the marker nearest to a ray (world); a third one starts another distance."""
        k = nearest_to_ray(self._markers, origin, direction) if self._active else None
        if k is not None:
            self._ends = [*self._ends, self._markers[k]] if len(self._ends) < 2 else [self._markers[k]]

    def update(self, state: ArenaState) -> None:
        """Follow the selected markers, and show their distance with its standard deviation."""
        timed = state.markers
        if timed is None or state.age_s(timed) > STALE_S:
            self._markers = np.empty((0, 3))
            return
        self._markers = timed.message.positions()
        rows = [_followed(end, self._markers) for end in self._ends]
        self._ends = [
            end if row is None else self._markers[row] for end, row in zip(self._ends, rows, strict=True)
        ]
        set_property(self._line, "visible", len(self._ends) == 2)
        if len(self._ends) == 2:
            self._line.points = np.array([self._ends], np.float32)
            first, second = rows
            if first is not None and second is not None:
                set_content(self._answer, small(describe_distance(timed.message, first, second)))

    def toggle(self, _: object) -> None:
        """Begin to measure, or end."""
        self._active, self._ends = not self._active, []
        set_property(self._button, "label", STOP if self._active else MEASURE)
        set_content(self._answer, small("click two markers in the scene" if self._active else ""))
        self._line.visible = False


def describe_distance(markers: Markers, first: int, second: int) -> str:
    """The distance of two markers in millimetres with its standard deviation, and along the axes of the world."""
    difference = markers.positions()[second] - markers.positions()[first]
    distance = float(np.linalg.norm(difference))
    C = np.frombuffer(markers.covariance, "<f4").reshape(-1, 3, 3)[[first, second]].sum(0)
    along = difference / max(distance, 1e-9)
    x, y, z = 1e3 * difference
    return (
        f"{1e3 * distance:.1f} mm ± {1e3 * np.sqrt(along @ C @ along):.1f} (x {x:.1f}, y {y:.1f}, z {z:.1f})"
    )


def _followed(end: Array, markers: Array) -> int | None:
    """The row of the marker nearest to where one was; None if it is hidden."""
    if not len(markers):
        return None
    distance = np.linalg.norm(markers - end, axis=1)
    return int(distance.argmin()) if distance.min() < FOLLOW_M else None
