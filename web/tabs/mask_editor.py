# SPDX-License-Identifier: BSD-3-Clause
"""Masks parts of a camera's image by clicks on its picture; `roundel settings NAME --mask` does so without a page.

The picture is shown in one browser, at a place of its own below the arena.
"""

import math
from collections.abc import Callable, Sequence
from contextlib import suppress

import numpy as np
import viser
from numpy.typing import ArrayLike, NDArray

from camera_node.foundation.arrays import Array
from camera_node.foundation.errors import ConfigError
from camera_node.protocol.camera_requests import Polygon, complete_corners, mask_of, mask_polygon
from camera_node.protocol.messages import Settings
from web.colours import MASK, SELECTED
from web.errors import WebError
from web.state.feed import ArenaState
from web.state.subscription import Subscription
from web.widgets import ActionButton, Answer

MAX_CORNERS = 64  # of one polygon
EXPLANATION = (
    "click two opposite corners of a rectangle, or three or more of a polygon, in the picture; then add it"
)
REFLECTIONS = "ignore the places of all roundels that are detected now: reflections, while none is in view"
CENTRE = np.array([0.0, 0.0, -500.0])  # far from the arena, which is out of view there
HEIGHT_M = 1.0  # of the picture in the scene
MARGIN = 1.15  # of the view around the picture
ABOVE_M = 0.002  # of lines before the picture
LINE_M = 0.004
# Columns: the axes of the picture in the world: u to the right, v down, and away from the viewer.
AXES = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
WXYZ = (math.sqrt(0.5), -math.sqrt(0.5), 0.0, 0.0)  # of AXES


class MaskEditor:
    """The folder "Mask": shows the picture of a camera in the scene of one browser, in which clicks select corners.

    Args:
        server: of the page.
        subscription: connected to the arena.
        camera: returns the name of the selected camera.
        picture: returns the current picture of a camera, (h, w, 3) RGB, or raises NetworkError.
        change: changes settings of a camera, with words for what changes; returns those in use.
    """

    def __init__(
        self,
        server: viser.ViserServer,
        subscription: Subscription,
        camera: Callable[[], str],
        picture: Callable[[str], NDArray[np.uint8]],
        change: Callable[[str, Settings, str], Settings],
    ) -> None:
        self._change = change
        self._subscription, self._camera, self._picture = subscription, camera, picture
        self._plane: PicturePlane | None = None
        self._edited = ""  # name of the camera whose picture is shown
        self._corners: list[Array] = []
        self._mask: tuple[Polygon, ...] = ()
        with server.gui.add_folder("Mask"):
            self._answer = answer = Answer(server.gui)
            gui = server.gui
            self._draw = ActionButton(gui, "Draw on the picture", self.begin, answer, EXPLANATION)
            self._add = ActionButton(gui, "Add what is drawn to the mask", self.add, answer)
            self._undo = ActionButton(gui, "Remove the last corner", self.remove_corner, answer)
            self._end = ActionButton(gui, "Back to the arena's view", self.end, answer)
            self._whole = (
                ActionButton(gui, "Mask everything detected now", self.mask_detected, answer, REFLECTIONS),
                ActionButton(gui, "Remove the mask", self.remove_mask, answer),
            )
        self._state = ArenaState()
        server.scene.on_click()(self._click)
        server.on_client_disconnect(self._forget)

    @property
    def is_open(self) -> bool:
        """Whether a picture is shown."""
        return self._plane is not None

    def update(self, state: ArenaState) -> None:
        """Enable the buttons that can act."""
        self._state, is_any = state, bool(state.cameras)
        for button in self._whole:
            button.show(enabled=is_any)
        self._draw.show(enabled=is_any and not self.is_open)
        self._add.show(enabled=len(self._corners) > 1, primary=len(self._corners) > 1)
        self._undo.show(enabled=bool(self._corners))
        self._end.show(enabled=self.is_open)

    def begin(self) -> str:
        """Show the picture of the selected camera to the browser that asks.

        Raises:
            NetworkError, RequestError: the camera does not answer.
        """
        client, name = self._draw.client, self._camera()
        if client is None:
            raise WebError("no browser asks; open the page")
        self._mask = self._subscription.change_settings(name).mask or ()
        image = self._picture(name)
        self._corners, self._edited = [], name
        self._plane = PicturePlane(client, image)
        self._redraw()
        return f"{name}, {len(self._mask)} masked places: {EXPLANATION}"

    def add(self) -> str:
        """Mask the polygon whose corners were selected. Raises ConfigError if it has no area, else as `begin`."""
        text = self._extend(self._edited, (mask_polygon(self._corners),))
        self._corners = []
        self._redraw()
        return text

    def mask_detected(self) -> str:
        """Add the places of all roundels that the camera detects now to its mask."""
        name = self._camera()
        detections = self._state.detections.get(name)
        if detections is None or not len(detections):
            raise ConfigError(f"{name} detects nothing now; there is nothing to mask")
        return self._extend(name, mask_of(detections))

    def remove_mask(self) -> str:
        """Have the camera ignore no place."""
        return self._set_mask(self._camera(), ())

    def remove_corner(self) -> str:
        """Forget the corner that was selected last."""
        del self._corners[-1:]
        self._redraw()
        return f"{len(self._corners)} corners"

    def end(self) -> str:
        """Remove the picture."""
        plane, self._plane, self._corners = self._plane, None, []
        if plane is not None:
            plane.close()
        return ""

    def select(self, origin: tuple[float, float, float], direction: tuple[float, float, float]) -> None:
        """Select the pixel in which a ray (world) meets the picture as the next corner."""
        uv = self._plane.pixel(origin, direction) if self._plane is not None else None
        if uv is None or len(self._corners) >= MAX_CORNERS:
            return
        self._corners.append(uv)
        self._redraw()
        self._answer.show(f"corner {len(self._corners)} at {uv[0]:.0f}, {uv[1]:.0f}", "ok")

    def _extend(self, name: str, polygons: tuple[Polygon, ...]) -> str:
        return self._set_mask(name, (*(self._subscription.change_settings(name).mask or ()), *polygons))

    def _set_mask(self, name: str, mask: tuple[Polygon, ...]) -> str:
        used = self._change(name, Settings(mask=mask), "the mask").mask or ()
        if name == self._edited:
            self._mask = used
            self._redraw()
        return f"{name}: {len(used)} masked places"

    def _redraw(self) -> None:
        if self._plane is not None:
            drawn = complete_corners(self._corners)
            self._plane.draw([drawn] if len(drawn) else [], self._mask)

    def _click(self, event: viser.SceneClickEvent) -> None:
        if self._plane is not None and event.client is self._plane.client:
            self.select(event.ray_origin, event.ray_direction)

    def _forget(self, client: viser.ClientHandle) -> None:
        """End with the browser that shows the picture."""
        if self._plane is not None and client is self._plane.client:
            with suppress(Exception):  # the browser no longer exists
                self.end()


class PicturePlane:
    """A picture in the scene of one browser, which looks at it until `close`.

    Args:
        client: the browser.
        image: (h, w, 3) RGB.
    """

    def __init__(self, client: viser.ClientHandle, image: NDArray[np.uint8]) -> None:
        self.client = client
        self.height, self.width = image.shape[:2]
        camera = client.camera
        self._before = camera.position, camera.look_at, camera.up_direction
        self._picture = client.scene.add_image(
            "/picture",
            image,
            HEIGHT_M * self.width / self.height,
            HEIGHT_M,
            format="jpeg",
            wxyz=WXYZ,
            position=CENTRE,
        )
        self._lines: dict[str, viser.LineSegmentsHandle] = {}
        self._look()

    def close(self) -> None:
        """Remove the picture, and show what the browser showed before."""
        for handle in (self._picture, *self._lines.values()):
            handle.remove()
        with self.client.atomic():
            camera = self.client.camera
            camera.up_direction = self._before[2]
            camera.position, camera.look_at = self._before[:2]

    def pixel(self, origin: ArrayLike, direction: ArrayLike) -> Array | None:
        """The pixel (2,) in which a ray (world) meets the picture; None if it misses it."""
        return pixel_on_plane(origin, direction, (self.width, self.height))

    def draw(self, drawn: Sequence[ArrayLike], masked: Sequence[ArrayLike]) -> None:
        """Draw the corners that were selected, (N, 2) pixels each, and the polygons of the mask."""
        self._draw_lines("drawn", drawn, SELECTED)
        self._draw_lines("masked", masked, MASK)

    def _draw_lines(self, name: str, polygons: Sequence[ArrayLike], colour: tuple[int, int, int]) -> None:
        if name in self._lines:
            self._lines.pop(name).remove()
        segments = [_outline(np.asarray(polygon, float), (self.width, self.height)) for polygon in polygons]
        if segments:
            self._lines[name] = self.client.scene.add_line_segments(
                f"/picture_{name}", np.concatenate(segments).astype(np.float32), colour, thickness=LINE_M
            )

    def _look(self) -> None:
        """Move the browser's viewpoint so that the whole picture is in view."""
        camera = self.client.camera
        half = max(HEIGHT_M, HEIGHT_M * self.width / self.height / max(camera.aspect, 0.1)) / 2
        distance = MARGIN * half / math.tan(camera.fov / 2)
        with self.client.atomic():
            camera.up_direction = -AXES[:, 1]
            camera.position, camera.look_at = CENTRE - distance * AXES[:, 2], CENTRE


def pixel_on_plane(origin: ArrayLike, direction: ArrayLike, size: tuple[int, int]) -> Array | None:
    """The pixel (2,) in which a ray (world) meets a picture of `size` (width, height); None if it misses it."""
    start, along = (np.asarray(origin, float) - CENTRE) @ AXES, np.asarray(direction, float) @ AXES
    if not along[2] > 0:
        return None
    x, y, _ = start - along * start[2] / along[2]
    width, height = size
    uv = np.array([x, y]) * height / HEIGHT_M + np.array([width, height]) / 2 - 0.5
    inside = bool((uv >= -0.5).all() and (uv < np.array([width, height]) - 0.5).all())
    return uv if inside else None


def _outline(uv: Array, size: tuple[int, int]) -> Array:
    """The sides of a polygon of pixels (N, 2) in the world, (N, 2, 3); those of a single pixel are a cross."""
    width, height = size
    if len(uv) == 1:
        arm = height / 60
        ends = uv[0] + arm * np.array([[[-1, 0], [1, 0]], [[0, -1], [0, 1]]])
    else:
        ends = np.stack([uv, np.roll(uv, -1, axis=0)], axis=1)
    metres = (ends + 0.5 - np.array([width, height]) / 2) * HEIGHT_M / height
    return CENTRE + metres @ AXES[:, :2].T - ABOVE_M * AXES[:, 2]
