# SPDX-License-Identifier: BSD-3-Clause
"""Where robots have been: a bounded tail behind each, all of them one array."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

LENGTH = 60  # points of one trail
JUMP_M = 1.0  # between two points: no robot drives so fast, and none leaves a line through the air


class Trails:
    """The last `LENGTH` positions of every robot; a trail starts at the first of them, and anew where a robot jumps."""

    def __init__(self) -> None:
        self._points: dict[str, NDArray[np.float32]] = {}

    def add(self, robot: str, position: ArrayLike) -> None:
        """Append one position, metres; the oldest goes."""
        new = np.asarray(position, np.float32)
        points = self._points.get(robot)
        if points is None:
            self._points[robot] = np.tile(new, (LENGTH, 1))
        elif (
            np.linalg.norm(new - points[-1]) > JUMP_M
        ):  # put elsewhere by hand, or another moment of a replay
            points[:] = new
        else:
            points[:-1], points[-1] = points[1:].copy(), new

    def segments(self, robots: list[str]) -> NDArray[np.float32]:
        """(len(robots) * (LENGTH - 1), 2, 3) line segments, a robot's oldest first; all of them were added before."""
        lines = [np.stack([p[:-1], p[1:]], axis=1) for p in (self._points[robot] for robot in robots)]
        return np.concatenate(lines) if lines else np.empty((0, 2, 3), np.float32)


def fade(colours: NDArray[np.uint8], background: ArrayLike) -> NDArray[np.uint8]:
    """(R * (LENGTH - 1), 2, 3) colours of the segments of R robots: from the background to the robot's own."""
    share = np.linspace(0.0, 1.0, LENGTH) ** 1.5
    lines = colours[:, None] * share[:, None] + np.asarray(background, float) * (1 - share[:, None])
    pairs = np.stack([lines[:, :-1], lines[:, 1:]], axis=2)
    return pairs.reshape(-1, 2, 3).astype(np.uint8)
