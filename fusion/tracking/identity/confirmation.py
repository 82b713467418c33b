# SPDX-License-Identifier: BSD-3-Clause
"""Confirms weak fits of robots over several frame sets."""

from dataclasses import dataclass

import numpy as np

from camera_node.arrays import Array
from fusion.tracking.identity.identification import RefinedFits

CONFIRMATIONS = 5  # frame sets in which a weak fit must be at one place
MAX_BETWEEN = 5  # frame sets from one to the next of these
SAME_PLACE_M = 0.15  # of a robot in two successive frame sets


@dataclass(frozen=True, slots=True, eq=False)
class _Sighting:
    """Where the last weak fit of a robot was (3,), in which frame set, and how many were at one place so far."""

    p: Array
    frame_set: int
    count: int

    @classmethod
    def after(cls, last: "_Sighting | None", p: Array, frame_set: int) -> "_Sighting":
        """The next sighting."""
        if last is None:
            return cls(p, frame_set, 1)
        stayed = np.linalg.norm(p - last.p) < SAME_PLACE_M * max(1, frame_set - last.frame_set)
        return cls(p, frame_set, last.count + 1 if stayed else 1)


class Confirmation:
    """Remembers where the weak fits of robots were."""

    def __init__(self) -> None:
        self._weak: dict[int, _Sighting] = {}  # by robot

    def confirmed(self, weak: list[RefinedFits], now: int) -> list[RefinedFits]:
        """The weak fits that were at one place in `CONFIRMATIONS` frame sets, and nowhere else between these.

        Args:
            weak: of a frame set.
            now: the number of this frame set.
        """
        self._weak = {k: seen for k, seen in self._weak.items() if now - seen.frame_set <= MAX_BETWEEN}
        for fits in weak:
            for robot, p in zip(fits.robot.tolist(), fits.states.p, strict=True):
                self._weak[robot] = _Sighting.after(self._weak.get(robot), p, now)
        return [
            fits.select(np.array([self._weak[k].count >= CONFIRMATIONS for k in fits.robot.tolist()], bool))
            for fits in weak
        ]
