# SPDX-License-Identifier: BSD-3-Clause
"""A new robot by clicks on its markers; `python -m fusion define` is the same without a page."""

import numpy as np
import viser
from numpy.typing import ArrayLike

from camera_node.arrays import Array
from camera_node.config import is_name
from camera_node.errors import RoundelError
from fusion.client.define import describe
from fusion.client.measure import StationaryMarkers, find_stationary_markers, robot_from_markers
from fusion.errors import FusionError
from web.drawing import PICKED
from web.feed import Latest
from web.panel import plain, write
from web.subscription import Subscription

AIM_RAD = 0.03  # a click is meant for the marker in this direction
WATCH_S = 1.5
SAME_M = 0.05  # a marker that was picked is still the one that stands there
PICK, DONE = "Pick its markers", "Pick no more"


class Picking:
    """Markers that a person has clicked, and the robot that they are to become."""

    def __init__(self, server: viser.ViserServer, subscription: Subscription) -> None:
        self.picked: list[Array] = []
        self._subscription = subscription
        self._free = np.empty((0, 3))  # positions of markers that no robot has and several cameras see, now
        self._picking = False
        with server.gui.add_folder("New robot"):
            self._button = server.gui.add_button(PICK)
            self._name = server.gui.add_text("Name", "robot")
            self._diameter = server.gui.add_number("Black disc, mm", 120.0, min=1.0, max=10_000.0, step=0.1)
            self._motion = server.gui.add_dropdown("Moves", ("aerial", "ground"))
            define = server.gui.add_button("Define it")
            self._answer = server.gui.add_markdown("")
        self._cloud = server.scene.add_point_cloud(
            "/picked",
            np.zeros((1, 3), np.float32),
            PICKED,
            point_size=0.06,
            point_shape="circle",
            visible=False,
        )
        self._button.on_click(lambda _: self._toggle())
        define.on_click(lambda _: write(self._answer, plain(self.define())))
        server.scene.on_click()(lambda click: self.pick(click.ray_origin, click.ray_direction))

    def update(self, latest: Latest) -> None:
        """Know the markers that there are now, and show those that are picked."""
        seen = latest.markers
        if seen is not None and latest.age(seen) < 1.0:
            self._free = seen.message.positions()[seen.message.unlabeled()]
        self._cloud.visible = bool(self.picked)
        if self.picked:
            self._cloud.points = np.array(self.picked, np.float32)

    def pick(self, origin: ArrayLike, direction: ArrayLike) -> None:
        """Take the marker along a ray (world), or give it back."""
        ray = np.asarray(direction, float) / np.linalg.norm(direction)
        to = self._free - np.asarray(origin, float)
        off = np.linalg.norm(np.cross(to, ray), axis=1) / np.maximum(to @ ray, 1e-9)
        if not self._picking or not len(off) or np.nanmin(off) > AIM_RAD:
            return
        marker = self._free[np.nanargmin(off)]
        others = [point for point in self.picked if np.linalg.norm(point - marker) > SAME_M]
        self.picked = others if len(others) < len(self.picked) else [*self.picked, marker]
        self._ask(f"{len(self.picked)} picked" if self.picked else "click on its markers, the grey ones")

    def define(self) -> str:
        """Measure what is picked and have the server look for it; what came of it, in words."""
        name = self._name.value
        try:
            if not is_name(name):
                raise FusionError(f"'{name}' can't name a robot; use letters, digits, - and _")
            if not self.picked:
                raise FusionError("no marker is picked")
            standing = _those(
                find_stationary_markers(self._subscription.watch(WATCH_S)), np.array(self.picked)
            )
            robot = robot_from_markers(standing, self._diameter.value / 1e3, self._motion.value)
            self._subscription.define(name, robot)
        except RoundelError as error:
            return str(error)
        self.picked = []
        return describe(name, robot)

    def _toggle(self) -> None:
        self._picking, self.picked = not self._picking, []
        self._button.label = DONE if self._picking else PICK
        self._ask(
            "click on its markers, the grey ones; the first shows where its x points" if self._picking else ""
        )

    def _ask(self, text: str) -> None:
        write(self._answer, plain(text))


def _those(standing: StationaryMarkers, picked: Array) -> StationaryMarkers:
    """The markers that were picked, in that order; FusionError where one does not stand there any more."""
    distance = np.linalg.norm(standing.position - picked[:, None], axis=2)  # picked x standing
    gone = np.min(distance, axis=1, initial=np.inf) > SAME_M
    if gone.any():
        x, y, z = picked[np.argmax(gone)]
        raise FusionError(f"the marker at {x:.2f}, {y:.2f}, {z:.2f} m does not stand still, or is not seen")
    nearest = distance.argmin(1)
    return StationaryMarkers(standing.position[nearest], standing.normal[nearest])
