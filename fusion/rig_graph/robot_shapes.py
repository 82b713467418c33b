# SPDX-License-Identifier: BSD-3-Clause
"""Where the markers of robots are on these, by what windows of keyframes show: a robot may be measured wrong.

docs/design/rig_graph.md has the model.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy.special import chdtri

from camera_node.foundation.arrays import Array
from fusion.model.observations import MarkerTable
from fusion.rig_graph.hypotheses import FALSE_ALARM, MAX_ITERATIONS, SHAPE_M, Fit, Window

DISPLACED_M = 1e-3  # less is what lenses and a careful measurement by hand leave
MIN_WINDOWS = 4  # for a variance: 3 for each coordinate of each marker


@dataclass(slots=True)
class _Mean:
    """Of displacements (m, 3) in n windows, with the sum of their squared differences from it."""

    n: int
    mean: Array
    squares: Array

    def add(self, off: Array) -> None:
        """Welford 1962."""
        self.n += 1
        before = off - self.mean
        self.mean = self.mean + before / self.n
        self.squares = self.squares + before * (off - self.mean)

    @property
    def variance(self) -> float:
        """Of a coordinate of the mean."""
        return float(self.squares.mean()) / (self.n - 1) / self.n


class RobotShapes:
    """The displacements of the markers of all robots from their places in `markers`."""

    def __init__(self, markers: MarkerTable) -> None:
        self._markers = markers
        self._means: dict[int, _Mean] = {}

    def add(self, displacements: Mapping[int, Array]) -> bool:
        """Add what a window shows, (m, 3) by robot; whether markers are used at other places from now on.

        A robot that has only another size stays as it is: it may be the rig that has.
        """
        has_placed = False
        for robot, off in displacements.items():
            rows = np.flatnonzero(self._markers.robot == robot)
            places = self._markers.position[:, rows].T
            mean = self._means.setdefault(robot, _Mean(0, np.zeros_like(off), np.zeros_like(off)))
            mean.add(_without(_motions(places), off))
            if mean.n < MIN_WINDOWS:
                continue
            of_shape = _without(_motions(places, has_size=True), mean.mean)
            off_m = np.linalg.norm(of_shape, axis=1).max()
            if off_m > DISPLACED_M and off_m**2 > chdtri(3, FALSE_ALARM) * mean.variance:
                self._markers.place(rows, places + in_own_frame(places, mean.mean))
                del self._means[robot]
                has_placed = True
        return has_placed


def displacements(window: Window, fit: Fit) -> dict[int, Array]:
    """(m, 3) by robot of which all markers are seen: how far they are from where they are declared, metres (body
    frame), by a fit in which their places are free."""
    seen = np.bincount(window.marker, minlength=len(window.owner)) > 0
    robots = [(robot, window.owner == robot) for robot in fit.hypothesis.robots]
    return {robot: fit.places[mine] for robot, mine in robots if seen[mine].all()}


def in_own_frame(places: Array, off: Array) -> Array:
    """Displacements (m, 3) of markers at `places` (m, 3), less the motion that they have in common.

    A window shows a shape, and not where a robot's frame is in it: it is where most markers stay. The cost is that of
    Cauchy with `SHAPE_M`, from the motions of all markers but one.
    """
    motions = _motions(places)
    starts = [_without(motions, off, 1.0 - np.eye(len(off))[k]) for k in range(len(off))]
    found = []
    for left in [off, *starts]:
        for _ in range(MAX_ITERATIONS):
            left = _without(motions, off, 1 / (1 + np.sum(left**2, axis=1) / SHAPE_M**2))
        found.append(left)
    return min(found, key=lambda left: np.log1p(np.sum(left**2, axis=1) / SHAPE_M**2).sum())


def _motions(places: Array, has_size: bool = False) -> Array:
    """(m, 3, 6) displacements of markers by a rotation and a translation of their robot; (m, 3, 7) with its size."""
    motions = np.zeros((len(places), 3, 6 + has_size))
    motions[:, :, :3] = np.cross(np.eye(3), places[:, None]).transpose(0, 2, 1)
    motions[:, :, 3:6] = np.eye(3)
    if has_size:
        motions[:, :, 6] = places
    return motions


def _without(motions: Array, off: Array, weight: Array | float = 1.0) -> Array:
    """What motions (m, 3, n), by weighted least squares, leave of displacements (m, 3)."""
    root = np.sqrt(np.broadcast_to(weight, len(off)))[:, None]
    rows = (root[:, :, None] * motions).reshape(-1, motions.shape[2])
    return off - motions @ np.linalg.lstsq(rows, (root * off).ravel(), rcond=None)[0]
