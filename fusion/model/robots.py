# SPDX-License-Identifier: BSD-3-Clause
"""Robots declared in `robots.yaml`; refuses symmetric constellations and robots that look alike.

The distances between its markers identify a constellation. An ambiguity by mirror reflection is harmless: the
reflected labeling turns the printed sides away from the cameras.
"""

import math
from itertools import combinations, permutations
from pathlib import Path
from typing import Literal

import msgspec
import numpy as np

from camera_node.arrays import Array, Index
from camera_node.config import NAME_RULE, dump_yaml, is_name, load_yaml, write_atomically
from camera_node.errors import ConfigError
from camera_node.geometry.body import Body
from camera_node.geometry.pose import rigid_motions
from camera_node.text import printable
from fusion.errors import FusionError

DISTINCT_M = (
    0.010  # smallest difference of some distance between two labelings: several sigma of triangulation
)
SIZES_DIFFER = 1.25  # smallest ratio of diameters that apparent size distinguishes
APART_M = 0.6  # between the starts of identical robots: several sigma of manual placement
MAX_MARKERS = 7  # limits the comparison of labelings at load, and the live acquisition, to milliseconds
MANOEUVRE_S = 0.1  # duration of an acceleration; converts accelerations to densities of white noise


class MotionModel(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Typical accelerations of a robot, each lasting about `MANOEUVRE_S`."""

    acceleration_m_s2: float
    angular_acceleration_rad_s2: float

    def __post_init__(self) -> None:
        if not (0 < self.acceleration_m_s2 < 1e4 and 0 < self.angular_acceleration_rad_s2 < 1e5):
            raise ValueError("the accelerations of a motion must be above 0, in m/s^2 and rad/s^2")

    @property
    def densities(self) -> tuple[float, float]:
        """Power spectral densities of white angular (rad^2/s^3) and linear (m^2/s^3) acceleration."""
        return (
            self.angular_acceleration_rad_s2**2 * MANOEUVRE_S,
            self.acceleration_m_s2**2 * MANOEUVRE_S,
        )


MOTIONS = {"ground": MotionModel(3.0, 15.0), "aerial": MotionModel(10.0, 40.0)}


class Robot(Body, frozen=True, kw_only=True, forbid_unknown_fields=True, omit_defaults=True):
    """A moving body with markers.

    Attributes:
        motion: `aerial` (also for hand-held robots), `ground` (smaller accelerations), or the accelerations.
        start_m: rough initial position; distinguishes single-marker robots and identical constellations.
    """

    motion: Literal["ground", "aerial"] | MotionModel = "aerial"
    start_m: tuple[float, float, float] | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if len(self.markers) > MAX_MARKERS:
            raise ValueError(f"{len(self.markers)} markers; a robot has {MAX_MARKERS} at most")
        for (i, a), (j, b) in combinations(enumerate(self.markers), 2):
            if math.dist(a, b) < self.diameter_m:
                raise ValueError(
                    f"markers {i} and {j} are {math.dist(a, b):.4g} m apart but {self.diameter_m:.4g} m in diameter: "
                    "their discs overlap; give all lengths in metres"
                )
        if len(self.markers) > 1 and np.linalg.matrix_rank(self.points - self.points[0], tol=0.02) < 2:
            raise ValueError(
                "two markers, or markers on one line, leave the rotation about the line unknown; "
                "place a third 20 mm or more off the line, or use a single marker"
            )

    @property
    def is_single(self) -> bool:
        return len(self.markers) == 1

    @property
    def densities(self) -> tuple[float, float]:
        """The densities of its motion; see `MotionModel.densities`."""
        return (MOTIONS[self.motion] if isinstance(self.motion, str) else self.motion).densities


class _Robots(msgspec.Struct, forbid_unknown_fields=True):
    robots: dict[str, Robot]


def load_robots(path: Path) -> dict[str, Robot]:
    """Read `robots.yaml`.

    Raises:
        ConfigError: the file is missing or broken, or declares no robot.
        FusionError: a constellation is symmetric, or two robots look alike.
    """
    robots = load_saved_robots(path)
    if not robots:
        raise ConfigError(f"{path} declares no robot; see configs/robots.yaml for an example")
    return robots


def load_saved_robots(path: Path) -> dict[str, Robot]:
    """Like `load_robots`, but accepts a file without robots: all may have been removed over the network."""
    robots = load_yaml(path, _Robots).robots
    require_trackable(robots, str(path))
    return robots


def save_robots(robots: dict[str, Robot], path: Path) -> None:
    """Write `robots.yaml` atomically; raise ConfigError if the folder is not writable."""
    write_atomically(path, dump_yaml(_Robots(robots)))


def require_trackable(robots: dict[str, Robot], where: str) -> None:
    """Raise ConfigError for an invalid name; raise FusionError like `require_distinct`."""
    if bad := [name for name in robots if not is_name(name)]:
        raise ConfigError(f"{where}: '{printable(bad[0], 80)}' can't name a robot; {NAME_RULE}")
    require_distinct(robots, where)


def changed(
    robots: dict[str, Robot],
    rename: dict[str, str],
    remove: tuple[str, ...],
    define: dict[str, Robot],
    replace: bool = False,
) -> dict[str, Robot]:
    """Rename, then remove, then define robots; returns the new robots.

    Raises:
        ConfigError: a name is invalid, unknown, or already in use; with `replace`, a defined robot may exist.
        FusionError: a constellation is symmetric, or two robots look alike.
    """
    if unknown := [name for name in (*rename, *remove) if name not in robots]:
        raise ConfigError(f"there is no robot '{unknown[0]}'; there are {', '.join(robots) or 'none'}")
    renamed = [rename.get(name, name) for name in robots]
    if taken := [name for name in renamed if renamed.count(name) > 1]:
        raise ConfigError(f"another robot has the name '{taken[0]}'; use a new name")
    remaining = {
        new: robot for new, (old, robot) in zip(renamed, robots.items(), strict=True) if old not in remove
    }
    existing = [name for name, robot in define.items() if remaining.get(name, robot) != robot]
    if existing and not replace:
        raise ConfigError(
            f"there is another robot '{existing[0]}': use another name, or confirm that it is replaced (--replace)"
        )
    require_trackable(remaining | define, "robots")
    return remaining | define


def require_distinct(robots: dict[str, Robot], where: str = "robots") -> None:
    """Raise FusionError if a robot has a rotational symmetry, or if two robots look alike."""
    for name, robot in robots.items():
        if fault := _likeness(robot, robot):
            raise FusionError(f"{where}: robot '{name}' is symmetric under rotation: {fault}")
    for (name_a, a), (name_b, b) in combinations(robots.items(), 2):
        if fault := _confusion(a, b):
            raise FusionError(f"{where}: robots '{name_a}' and '{name_b}' are {fault}")


def _confusion(a: Robot, b: Robot) -> str | None:
    """Why two robots look alike; None if they differ."""
    if max(a.diameter_m, b.diameter_m) > SIZES_DIFFER * min(a.diameter_m, b.diameter_m):
        return None
    if a.is_single and b.is_single:
        return _lack_of_starts(a, b, f"print one of them {SIZES_DIFFER:g} times as large")
    if a.is_single or b.is_single:
        return None  # acquisition resolves a single marker that belongs to a constellation
    if a.markers == b.markers and a.diameter_m == b.diameter_m:
        return _lack_of_starts(a, b, f"move a marker of one by {DISTINCT_M * 1e3:.0f} mm")
    fault = _likeness(*sorted((a, b), key=lambda robot: len(robot.markers)))
    return fault and f"too alike: {fault}"


def _lack_of_starts(a: Robot, b: Robot, remedy: str) -> str | None:
    """Why two identical robots have no distinct starts; only their history distinguishes them."""
    if a.start_m and b.start_m and math.dist(a.start_m, b.start_m) >= APART_M:
        return None
    return f"identical: give both a start_m, {APART_M:g} m or more apart, or {remedy}"


def distances(points: Array) -> Array:
    """(M, M) distances between points (M, 3)."""
    return np.linalg.norm(points[:, None] - points[None], axis=2)


def align(a: Array, b: Array) -> tuple[Array, Array]:
    """The rotation (3, 3) and translation (3,) that align points a (M, 3) with b (Kabsch 1976)."""
    T = rigid_motions(a, b)
    return T[:3, :3], T[:3, 3]


def _likeness(small: Robot, large: Robot) -> str | None:
    """How the markers of `small` match some of `large`; for the same robot, in another order. None if they don't."""
    D, E = distances(small.points), distances(large.points)
    orders = np.array(list(permutations(range(len(large.markers)), len(small.markers))))
    if small is large:
        orders = orders[1:]  # the first is the identity
    worst = np.abs(D - E[orders[:, :, None], orders[:, None]])  # (labelings, M, M)
    for k in np.flatnonzero(worst.max((1, 2)) < DISTINCT_M):
        if align(small.points, large.points[orders[k]])[0][2, 2] > 0:
            return _explain(D, E, orders[k], worst[k])
    return None


def _explain(D: Array, E: Array, order: Index, worst: Array) -> str:
    i, j = np.unravel_index(np.argmax(worst), worst.shape)
    a, b = sorted((order[i], order[j]))
    return (
        f"the distance between markers {i} and {j} ({D[i, j] * 1e3:.1f} mm) and that between {a} and {b} "
        f"({E[a, b] * 1e3:.1f} mm) differ most, by only {worst[i, j] * 1e3:.1f} mm; move a marker until "
        f"they differ by {DISTINCT_M * 1e3:.0f} mm or more"
    )
