# SPDX-License-Identifier: BSD-3-Clause
"""Shows a camera's picture in one browser, at a place of its own below the arena, to select pixels by clicks."""

import math
from collections.abc import Sequence

import numpy as np
import viser
from numpy.typing import ArrayLike, NDArray

from camera_node.foundation.arrays import Array
from web.colours import MASK, SELECTED

CENTRE = np.array([0.0, 0.0, -500.0])  # far from the arena, which is out of view there
HEIGHT_M = 1.0  # of the picture in the scene
MARGIN = 1.15  # of the view around the picture
ABOVE_M = 0.002  # of lines before the picture
LINE_M = 0.004
# Columns: the axes of the picture in the world: u to the right, v down, and away from the viewer.
AXES = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
WXYZ = (math.sqrt(0.5), -math.sqrt(0.5), 0.0, 0.0)  # of AXES


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
