# SPDX-License-Identifier: BSD-3-Clause
"""Stores the recent positions of robots and turns them into line segments."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

LENGTH = 60  # positions of one trail
JUMP_M = 1.0  # a longer step is a jump, not motion: the trail restarts
FADE_EXPONENT = 1.5


class Trails:
    """The last `LENGTH` positions of each robot. A trail restarts where a robot jumps."""

    def __init__(self) -> None:
        self._points: dict[str, NDArray[np.float32]] = {}

    def add(self, robot: str, position: ArrayLike) -> None:
        """Append a position (3,), metres, and drop the oldest."""
        new = np.asarray(position, np.float32)
        points = self._points.get(robot)
        if points is None:
            self._points[robot] = np.tile(new, (LENGTH, 1))
        elif np.linalg.norm(new - points[-1]) > JUMP_M:  # moved by hand, or a replay that jumped
            points[:] = new
        else:
            points[:-1], points[-1] = points[1:].copy(), new

    def remove(self, robot: str) -> None:
        """Forget a robot."""
        self._points.pop(robot, None)

    def segments(self, robots: list[str]) -> NDArray[np.float32]:
        """Return the trails of robots that were added: (len(robots) * (LENGTH - 1), 2, 3), the oldest first."""
        lines = [np.stack([p[:-1], p[1:]], axis=1) for p in (self._points[robot] for robot in robots)]
        return np.concatenate(lines) if lines else np.empty((0, 2, 3), np.float32)


def fade(colours: NDArray[np.uint8], background: ArrayLike) -> NDArray[np.uint8]:
    """Return the segments' colours for R robots, (R * (LENGTH - 1), 2, 3), from the background to the robot's own."""
    share = np.linspace(0.0, 1.0, LENGTH) ** FADE_EXPONENT
    lines = colours[:, None] * share[:, None] + np.asarray(background, float) * (1 - share[:, None])
    pairs = np.stack([lines[:, :-1], lines[:, 1:]], axis=2)
    return pairs.reshape(-1, 2, 3).astype(np.uint8)
