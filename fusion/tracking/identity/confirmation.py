# SPDX-License-Identifier: BSD-3-Clause
"""Confirms weak fits of constellations in several frame sets.

Markers of another body fit a constellation by an invented velocity of about 1 m/s, which moves them by the centimetres
that they are off between the exposures of free-running cameras. Such fits stay where they are although they have a
velocity.
"""

from dataclasses import dataclass

import numpy as np

from camera_node.foundation.arrays import Array
from fusion.model.states import VELOCITY, States
from fusion.tracking.gating import POSITION_GATE
from fusion.tracking.identity.identification import RefinedFits

CONFIRMATIONS = 5  # frame sets in which a weak fit must be at one place
MAX_BETWEEN = 5  # frame sets from one to the next of these
SAME_PLACE_M = 0.15  # of a robot in two successive frame sets
SLACK_M_S = 0.15  # of a velocity, beyond its covariance


@dataclass(frozen=True, slots=True, eq=False)
class _Sighting:
    """The last weak fit of a robot.

    Attributes:
        p: (3,) its position.
        t_ns, frame_set: when it was.
        count: how many were at one place so far.
        drift: (3,) how far these moved, less what their velocities say.
        since_ns: the time of the first of these.
        cov_v: (3, 3) covariance of the last velocity; the same cameras make the same error in each frame set.
    """

    p: Array
    t_ns: int
    frame_set: int
    count: int
    drift: Array
    since_ns: int
    cov_v: Array

    @classmethod
    def of(cls, fit: States, t_ns: int, frame_set: int, last: "_Sighting | None") -> "_Sighting":
        """The sighting of one fit, after the last one."""
        p, v, cov_v = fit.p[0], fit.v[0], fit.P[0, VELOCITY, VELOCITY]
        first = cls(p, t_ns, frame_set, 1, np.zeros(3), t_ns, cov_v)
        if last is None:
            return first
        moved = p - last.p
        if np.linalg.norm(moved) > SAME_PLACE_M * max(1, frame_set - last.frame_set):
            return first
        drift = last.drift + moved - (t_ns - last.t_ns) * 1e-9 * v
        return cls(p, t_ns, frame_set, last.count + 1, drift, last.since_ns, cov_v)

    @property
    def is_confirmed(self) -> bool:
        """Whether enough fits were at one place, and moved as their velocities say."""
        if self.count < CONFIRMATIONS or self.t_ns <= self.since_ns:
            return False
        off = self.drift / ((self.t_ns - self.since_ns) * 1e-9)
        return bool(off @ np.linalg.solve(self.cov_v + SLACK_M_S**2 * np.eye(3), off) < POSITION_GATE)


class WeakFits:
    """The last weak fit of each robot."""

    def __init__(self) -> None:
        self._last: dict[int, _Sighting] = {}

    def confirm(self, weak: list[RefinedFits], t_ns: int, frame_set: int) -> list[RefinedFits]:
        """Of the weak fits of a frame set, those that were at one place in `CONFIRMATIONS`, and nowhere else between.

        Args:
            weak: at most one of each robot.
            t_ns: time of the frame set.
            frame_set: its number.
        """
        self._last = {k: seen for k, seen in self._last.items() if frame_set - seen.frame_set <= MAX_BETWEEN}
        for fits in weak:
            for k, robot in enumerate(fits.robot.tolist()):
                state, last = fits.states.select(np.array([k])), self._last.get(robot)
                self._last[robot] = _Sighting.of(state, t_ns, frame_set, last)
        return [
            fits.select(np.array([self._last[k].is_confirmed for k in fits.robot.tolist()], bool))
            for fits in weak
        ]
