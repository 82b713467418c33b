# SPDX-License-Identifier: BSD-3-Clause
"""Defines a new robot from markers that the user selects in the page; `roundel define` does so without one."""

from collections.abc import Callable
from typing import Any

import numpy as np
import viser
from numpy.typing import ArrayLike, NDArray

from camera_node.foundation.arrays import Array
from camera_node.foundation.config import require_name
from fusion.client.robot_definition import (
    LONE,
    StationaryMarkers,
    describe,
    find_stationary_markers,
    robot_from_markers,
)
from fusion.errors import FusionError
from web.colours import SELECTED
from web.condition import next_step
from web.html_tables import small
from web.own_control import OwnControl
from web.scene.clicks import nearest_to_ray
from web.scene.markers import add_points, show_points
from web.state.feed import ArenaState
from web.state.subscription import Subscription
from web.tables import STALE_S
from web.widgets import GREY, PRIMARY, ActionButton, Answer, set_content, set_property

MEASURE_S = 1.5  # for which the markers of the new robot are measured
SAME_M = 0.05  # distance up to which a measured marker is the selected one
NOTHING_SEEN = "no unlabeled marker in view: place the robot, markers up, where two cameras see it"
FIELDS: tuple[Callable[[viser.GuiApi], Any], ...] = (  # name, diameter, motion
    lambda gui: gui.add_text("Name", "robot"),
    lambda gui: gui.add_number("Black disc, mm", 90.0, min=1.0, max=10_000.0, step=0.1),
    lambda gui: gui.add_dropdown("Motion", ("aerial", "ground")),
)
SELECT, STOP = "Select markers", "Stop selecting"


class MarkerPicker:
    """The panel's folder "New robot" and the markers that are selected for it."""

    def __init__(self, server: viser.ViserServer, subscription: Subscription) -> None:
        self.selected: list[Array] = []  # positions (3,), world
        self._subscription = subscription
        self._unlabeled = np.empty((0, 3))  # positions of unlabeled markers that several cameras saw lately
        # By the time of their message, the feed's seconds: a marker may be missing in single messages.
        self._seen_lately: dict[float, Array] = {}
        self._active = False
        place = server.gui.add_folder("New robot")
        with place:
            self._seen = server.gui.add_html(small(NOTHING_SEEN))
            self._button = server.gui.add_button(SELECT, color=GREY)
            self._name, self._diameter, self._motion = (OwnControl(server, place, add) for add in FIELDS)
            self._answer = Answer(server.gui)
            self._define_selected = ActionButton(
                server.gui,
                "Define robot",
                self.define,
                self._answer,
                f"measures the selected markers for 1.5 s; {LONE}",
            )
            self._everything = ActionButton(
                server.gui,
                "Define from everything stationary",
                self.define_stationary,
                self._answer,
                "measures all unlabeled markers for 1.5 s and makes one robot of those that stand still",
            )
        self._cloud = add_points(server.scene, "/selected", SELECTED, 0.06)
        self._button.on_click(lambda _: self._toggle())
        server.scene.on_click()(lambda click: self.select(click.ray_origin, click.ray_direction))

    def update(self, state: ArenaState) -> None:
        """Store the current unlabeled markers, and draw the selected ones."""
        timed = state.markers
        if timed is not None and state.age_s(timed) < STALE_S:
            rows = timed.message.unlabeled()
            self._seen_lately[timed.received_s] = timed.message.positions()[rows]
            set_content(self._seen, small(describe_unlabeled(timed.message.diameters()[rows])))
        self._seen_lately = {s: at for s, at in self._seen_lately.items() if state.now_s - s < STALE_S}
        self._unlabeled = np.vstack([np.empty((0, 3)), *self._seen_lately.values()])
        is_next = next_step(state) == "robots"
        set_property(self._button, "color", PRIMARY if is_next and not self.selected else GREY)
        set_property(self._button, "disabled", not self._active and not len(self._unlabeled))
        self._everything.show(enabled=len(self._unlabeled) > 0)
        self._define_selected.show(enabled=bool(self.selected), primary=bool(self.selected))
        show_points(self._cloud, self.selected)

    def select(self, origin: ArrayLike, direction: ArrayLike) -> None:
        """Select the marker nearest to a ray (world), or deselect it."""
        unlabeled = self._unlabeled  # the thread that draws replaces it
        row = nearest_to_ray(unlabeled, origin, direction) if self._active else None
        if row is None:
            return
        marker = unlabeled[row]
        others = [point for point in self.selected if np.linalg.norm(point - marker) > SAME_M]
        self.selected = others if len(others) < len(self.selected) else [*self.selected, marker]
        self._answer_with(
            f"{len(self.selected)} selected" if self.selected else "click the robot's grey markers"
        )

    def define(self) -> str:
        """Measure the selected markers and have the server track the robot; return the outcome as text.

        Raises:
            RoundelError: the name can't be one or is in use, a marker moves, or the server does not answer.
        """
        name = require_name(self._name.here.value, "a robot")
        if not self.selected:
            raise FusionError("no marker is selected")
        measured = find_stationary_markers(self._subscription.collect_markers(MEASURE_S))
        standing = _match_selected(measured, np.array(self.selected))
        return self._define(name, standing)

    def define_stationary(self) -> str:
        """Have the server track a robot of all stationary unlabeled markers; returns and raises as `define`."""
        name = require_name(self._name.here.value, "a robot")
        return self._define(name, find_stationary_markers(self._subscription.collect_markers(MEASURE_S)))

    def _define(self, name: str, markers: StationaryMarkers) -> str:
        robot = robot_from_markers(markers, self._diameter.here.value / 1e3, self._motion.here.value)
        robots = self._subscription.define(name, robot)
        self.selected = []
        return describe(name, robots)

    def _toggle(self) -> None:
        self._active, self.selected = not self._active, []
        self._button.label = STOP if self._active else SELECT
        self._answer_with(
            "click the robot's grey markers; its x axis points to the first" if self._active else ""
        )

    def _answer_with(self, text: str) -> None:
        self._answer.show(text)


def describe_unlabeled(diameters_m: NDArray[np.float32]) -> str:
    """How many unlabeled markers are in view, and the median of their diameters (N,), metres, NaN where unknown."""
    if not len(diameters_m):
        return NOTHING_SEEN
    known = diameters_m[np.isfinite(diameters_m)]
    size = f", discs of about {1e3 * np.median(known):.0f} mm" if len(known) else ""
    return f"unlabeled markers in view: {len(diameters_m)}{size}"


def _match_selected(measured: StationaryMarkers, selected: Array) -> StationaryMarkers:
    """Return the measured markers at the selected positions (N, 3), in their order.

    Raises:
        FusionError: there is no measured marker within `SAME_M` of a selected position.
    """
    distance = np.linalg.norm(measured.position - selected[:, None], axis=2)  # selected x measured
    missing = np.min(distance, axis=1, initial=np.inf) > SAME_M
    if missing.any():
        x, y, z = selected[np.argmax(missing)]
        raise FusionError(
            f"the marker at {x:.2f}, {y:.2f}, {z:.2f} m moves or is not visible; hold the robot still"
        )
    nearest = distance.argmin(1)
    return measured.select(nearest)
