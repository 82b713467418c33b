# SPDX-License-Identifier: BSD-3-Clause
"""Robots as people declare them in `robots.yaml`; those that nothing could tell apart are refused.

A constellation is known by the distances between its markers. A labelling that only a mirror could bring about is
harmless: it would turn the printed sides away from the cameras.
"""

import math
from itertools import combinations, permutations
from pathlib import Path
from typing import Literal

import msgspec
import numpy as np

from camera_node.arrays import Array, Index
from camera_node.config import dump_yaml, is_name, load_yaml, write_atomically
from camera_node.errors import ConfigError
from camera_node.geometry.body import Body
from camera_node.geometry.pose import rigid_motions
from fusion.errors import FusionError

DISTINCT_M = 0.010  # two labellings must differ by this in some distance: several sigma of a triangulated one
SIZES_DIFFER = 1.25  # diameters in this ratio are told apart by apparent size
APART_M = 0.6  # between the starts of identical robots: several sigma of where a person puts them
MAX_MARKERS = 7  # keeps the comparison of all labellings at load, and the search live, in milliseconds
MANOEUVRE_S = 0.1  # how long an acceleration lasts, to turn its size into the density of white noise


class MotionModel(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """How violently a robot moves: typical accelerations, each lasting about `MANOEUVRE_S`."""

    acceleration_m_s2: float
    angular_acceleration_rad_s2: float

    def __post_init__(self) -> None:
        if not (0 < self.acceleration_m_s2 < 1e4 and 0 < self.angular_acceleration_rad_s2 < 1e5):
            raise ValueError("accelerations of a motion must be above 0")

    @property
    def densities(self) -> tuple[float, float]:
        """Power spectral densities of white acceleration: angular rad^2/s^3, linear m^2/s^3."""
        return (
            self.angular_acceleration_rad_s2**2 * MANOEUVRE_S,
            self.acceleration_m_s2**2 * MANOEUVRE_S,
        )


MOTIONS = {"ground": MotionModel(3.0, 15.0), "aerial": MotionModel(10.0, 40.0)}


class Robot(Body, frozen=True, kw_only=True, forbid_unknown_fields=True, omit_defaults=True):
    """A body that moves.

    Attributes:
        motion: `aerial` (also what a hand does), the calmer `ground`, or the accelerations themselves.
        start_m: roughly where a robot stands at first; what tells robots of one marker, or of the same markers, apart.
    """

    motion: Literal["ground", "aerial"] | MotionModel = "aerial"
    start_m: tuple[float, float, float] | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if len(self.markers) > MAX_MARKERS:
            raise ValueError(f"a robot has {MAX_MARKERS} markers at the most")
        for (i, a), (j, b) in combinations(enumerate(self.markers), 2):
            if math.dist(a, b) < self.diameter_m:
                raise ValueError(
                    f"markers {i} and {j} are {math.dist(a, b):.4g} m apart and {self.diameter_m:.4g} m across: "
                    "their discs would overlap; all lengths are in metres"
                )
        if len(self.markers) > 1 and np.linalg.matrix_rank(self.points - self.points[0], tol=0.02) < 2:
            raise ValueError(
                "markers on one line (or only two) leave the turn about it unknown; "
                "place a third 20 mm or more off the line, or use a single marker"
            )

    @property
    def is_single(self) -> bool:
        return len(self.markers) == 1

    @property
    def densities(self) -> tuple[float, float]:
        """Those of its motion: see `MotionModel.densities`."""
        return (MOTIONS[self.motion] if isinstance(self.motion, str) else self.motion).densities


class _Robots(msgspec.Struct, forbid_unknown_fields=True):
    robots: dict[str, Robot]


def load_robots(path: Path) -> dict[str, Robot]:
    """Read `robots.yaml`.

    Raises:
        ConfigError: the file is missing or broken, or declares no robot.
        FusionError: a constellation is symmetric, or two robots are too alike to be told apart.
    """
    robots = load_saved_robots(path)
    if not robots:
        raise ConfigError(f"{path} declares no robot; see configs/robots.yaml for an example")
    return robots


def load_saved_robots(path: Path) -> dict[str, Robot]:
    """As `load_robots`; there may be none, where all were removed over the network."""
    robots = load_yaml(path, _Robots).robots
    require_trackable(robots, str(path))
    return robots


def save_robots(robots: dict[str, Robot], path: Path) -> None:
    """Write robots as a `robots.yaml`, atomically; ConfigError where the folder can't be written to."""
    write_atomically(path, dump_yaml(_Robots(robots)))


def require_trackable(robots: dict[str, Robot], where: str) -> None:
    """Raise ConfigError if a name can't be one, FusionError as `require_distinct` does."""
    if bad := [name for name in robots if not is_name(name)]:
        raise ConfigError(f"{where}: '{bad[0]}' can't name a robot; use letters, digits, - and _")
    require_distinct(robots, where)


def changed(
    robots: dict[str, Robot], rename: dict[str, str], remove: tuple[str, ...], define: dict[str, Robot]
) -> dict[str, Robot]:
    """The robots with some renamed, then some removed, then some defined.

    Raises:
        ConfigError: a name is none, is unknown, or is taken.
        FusionError: a constellation is symmetric, or two robots are too alike to be told apart.
    """
    if unknown := [name for name in (*rename, *remove) if name not in robots]:
        raise ConfigError(f"there is no robot '{unknown[0]}'; there are {', '.join(robots) or 'none'}")
    renamed = [rename.get(name, name) for name in robots]
    if taken := [name for name in renamed if renamed.count(name) > 1]:
        raise ConfigError(f"the name '{taken[0]}' is taken")
    kept = {
        new: robot for new, (old, robot) in zip(renamed, robots.items(), strict=True) if old not in remove
    }
    require_trackable(kept | define, "robots")
    return kept | define


def require_distinct(robots: dict[str, Robot], where: str = "robots") -> None:
    """Raise FusionError if a robot looks the same when turned, or two robots can't be told apart."""
    for name, robot in robots.items():
        if fault := _likeness(robot, robot):
            raise FusionError(f"{where}: robot '{name}' looks the same when turned: {fault}")
    for (name_a, a), (name_b, b) in combinations(robots.items(), 2):
        if fault := _confusion(a, b):
            raise FusionError(f"{where}: robots '{name_a}' and '{name_b}' are {fault}")


def _confusion(a: Robot, b: Robot) -> str | None:
    """Why two robots can't be told apart."""
    if max(a.diameter_m, b.diameter_m) > SIZES_DIFFER * min(a.diameter_m, b.diameter_m):
        return None
    if a.is_single and b.is_single:
        return _lack_of_starts(a, b, f"print one of them {SIZES_DIFFER:g} times as large")
    if a.is_single or b.is_single:
        return None  # which a constellation finds out by itself
    if a.markers == b.markers and a.diameter_m == b.diameter_m:
        return _lack_of_starts(a, b, f"move a marker of one by {DISTINCT_M * 1e3:.0f} mm")
    fault = _likeness(*sorted((a, b), key=lambda robot: len(robot.markers)))
    return fault and f"too alike: {fault}"


def _lack_of_starts(a: Robot, b: Robot, remedy: str) -> str | None:
    """Robots that look the same are told apart by history, which needs a beginning."""
    if a.start_m and b.start_m and math.dist(a.start_m, b.start_m) >= APART_M:
        return None
    return f"identical: give both a start_m, {APART_M:g} m or more apart, or {remedy}"


def distances(points: Array) -> Array:
    """(M, M) distances between points (M, 3)."""
    return np.linalg.norm(points[:, None] - points[None], axis=2)


def align(a: Array, b: Array) -> tuple[Array, Array]:
    """The rotation (3, 3) and translation (3,) that bring points a (M, 3) nearest to b (Kabsch 1976)."""
    T = rigid_motions(a, b)
    return T[:3, :3], T[:3, 3]


def _likeness(small: Robot, large: Robot) -> str | None:
    """How `small` could be taken for markers of `large`, in another order if they are the same robot."""
    D, E = distances(small.points), distances(large.points)
    orders = np.array(list(permutations(range(len(large.markers)), len(small.markers))))
    if small is large:
        orders = orders[1:]  # without the one that is its own
    worst = np.abs(D - E[orders[:, :, None], orders[:, None]])  # (labellings, M, M)
    for k in np.flatnonzero(worst.max((1, 2)) < DISTINCT_M):
        if align(small.points, large.points[orders[k]])[0][2, 2] > 0:
            return _explain(D, E, orders[k], worst[k])
    return None


def _explain(D: Array, E: Array, order: Index, worst: Array) -> str:
    i, j = np.unravel_index(np.argmax(worst), worst.shape)
    a, b = sorted((order[i], order[j]))
    return (
        f"the distance of markers {i} and {j} ({D[i, j] * 1e3:.1f} mm) and that of {a} and {b} "
        f"({E[a, b] * 1e3:.1f} mm) differ most of all, by {worst[i, j] * 1e3:.1f} mm; move a marker until "
        f"they differ by {DISTINCT_M * 1e3:.0f} mm or more"
    )
