# SPDX-License-Identifier: BSD-3-Clause
"""A leader and two followers: their start, their control, and how well they hold their distances."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from itertools import combinations

import numpy as np

from camera_node.foundation.arrays import Array
from web.formation.control import Controller, Follower, Leader, place_of
from web.formation.planar import compose
from web.formation.world import RobotWorld

LEADER, LEFT, RIGHT = "leader", "left", "right"
SIDES = {LEFT: 1, RIGHT: -1}
START = np.array([1.0, 0.0, np.pi])  # of the leader in the world
START_ERROR = np.array([0.12, 0.12, 0.1])  # of the followers: standard deviations
RADIUS_M = 0.15  # of a robot
SETTLED_S = 5.0  # from the start; later distances count
LIMIT_M = 0.02


def start_world(seed: int = 0) -> RobotWorld:
    """The robots at rest; the followers are near their places."""
    rng = np.random.default_rng(seed)
    poses = {LEADER: START}
    for name, side in SIDES.items():
        poses[name] = compose(START, place_of(side)) + START_ERROR * rng.standard_normal(3)
    return RobotWorld(poses, seed)


def controllers() -> dict[str, Controller]:
    """The control of each robot."""
    return {LEADER: Leader(), **{name: Follower(side) for name, side in SIDES.items()}}


def wanted_distances() -> dict[tuple[str, str], float]:
    """The distance of each pair of robots in formation, metres."""
    places = {LEADER: np.zeros(3)} | {name: place_of(side) for name, side in SIDES.items()}
    return {pair: _distance(places, pair) for pair in combinations(places, 2)}


@dataclass
class FormationScore:
    """Collects the distances of all pairs of robots; `errors_m` are those since `SETTLED_S`."""

    errors_m: dict[tuple[str, str], list[float]] = field(default_factory=dict)
    nearest_m: float = np.inf
    travelled_m: float = 0.0
    _last: Array | None = None

    def add(self, t_s: float, poses: Mapping[str, Array]) -> None:
        """Add the true poses (3,) of all robots at `t_s`."""
        for pair, wanted in wanted_distances().items():
            distance = _distance(poses, pair)
            self.nearest_m = min(self.nearest_m, distance)
            if t_s >= SETTLED_S:
                self.errors_m.setdefault(pair, []).append(distance - wanted)
        if self._last is not None:
            self.travelled_m += float(np.linalg.norm(poses[LEADER][:2] - self._last[:2]))
        self._last = poses[LEADER]

    @property
    def largest_error_m(self) -> float:
        """The largest error of a distance; 0 before any counts."""
        return max((abs(e) for errors in self.errors_m.values() for e in errors), default=0.0)

    def faults(self) -> list[str]:
        """What was not as it should be."""
        faults = []
        if self.nearest_m < 2 * RADIUS_M:
            faults.append(f"two robots collided: {self.nearest_m:.2f} m between their centres")
        if self.largest_error_m > LIMIT_M:
            faults.append(f"a distance was wrong by {1e3 * self.largest_error_m:.0f} mm")
        return faults

    def summarize(self) -> list[str]:
        """One line for each pair of robots."""
        lines = [
            f"the leader drove {self.travelled_m:.1f} m; no two robots came nearer than {self.nearest_m:.2f} m"
        ]
        for (a, b), wanted in wanted_distances().items():
            e = 1e3 * np.array(self.errors_m.get((a, b), []))
            if len(e):
                rms, most = np.sqrt(np.mean(e**2)), np.abs(e).max()
                lines.append(f"{a} - {b}: {wanted:.3f} m, error {rms:.1f} mm RMS, {most:.1f} mm at most")
        return lines


def _distance(poses: Mapping[str, Array], pair: tuple[str, str]) -> float:
    return float(np.linalg.norm(poses[pair[0]][:2] - poses[pair[1]][:2]))
