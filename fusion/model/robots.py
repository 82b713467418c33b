# SPDX-License-Identifier: BSD-3-Clause
"""Robots declared in `robots.yaml`: checked, saved and changed.

Symmetric constellations and robots that look alike are refused. A robot's own frame can have another origin (pivot), or
another direction of its x axis (heading).
"""

import math
from collections import Counter
from collections.abc import Collection
from itertools import chain, combinations, product
from pathlib import Path
from typing import Literal

import msgspec
import numpy as np

from camera_node.foundation.arrays import Array
from camera_node.foundation.config import (
    NAME_RULE,
    dump_yaml,
    example_file,
    is_name,
    load_yaml,
    write_atomically,
)
from camera_node.foundation.errors import ConfigError, printable
from camera_node.geometry.body import Body, are_parallel
from fusion.errors import FusionError
from fusion.model.likeness import DISTINCT_M, likeness, sides, symmetry

SIZES_DIFFER = 1.25  # smallest ratio of diameters that apparent size distinguishes
APART_M = 0.6  # between the starts of identical robots: several sigma of manual placement
# These limit the comparison of labelings at load, and the live acquisition, to milliseconds.
MAX_MARKERS, MAX_SIDE_MARKERS = 28, 7
BACK_COS = 0.5  # between normals, below which discs are on different faces and can't overlap
# Of the diameter, between discs on different faces: acquisition takes closer ones for one marker.
BACK_SHARE = 0.6
MAX_ROBOTS, MAX_ALL_MARKERS = 256, 1024  # of one arena: more than one process follows, or two
MAX_PIVOT_M = 5.0
DECIMALS = 5  # of marker positions in a changed frame: hundredths of a millimetre
MANOEUVRE_S = 0.1  # duration of an acceleration; converts accelerations to densities of white noise


class MotionModel(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The largest accelerations of a robot's usual motion, each lasting about `MANOEUVRE_S`; `tracking/motion_models`
    estimates how much less it does."""

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
        self._require_few_markers()
        self._require_apart()
        if self.is_single and self.normals:
            raise ValueError("a single marker defines the z axis of its robot: leave its normal out")
        if len(self.markers) > 1 and not self.is_coded and are_parallel(self.points - self.points[0]):
            raise ValueError(
                "two markers, or markers on one line, leave the rotation about the line unknown; "
                "place a third 20 mm or more off the line, or use a single marker"
            )

    def _require_few_markers(self) -> None:
        """Raise ValueError for more markers than acquisition can search for."""
        if len(self.markers) > MAX_MARKERS:
            raise ValueError(f"{len(self.markers)} markers; a robot has {MAX_MARKERS} at most")
        if (most := max(map(len, sides(self)))) > MAX_SIDE_MARKERS:
            raise ValueError(
                f"{most} markers that face one way; a robot has {MAX_SIDE_MARKERS} at most on a side"
            )

    def _require_apart(self) -> None:
        """Raise ValueError where discs overlap, or are back to back at almost one place."""
        along = self.unit_normals @ self.unit_normals.T
        for (i, a), (j, b) in combinations(enumerate(self.markers), 2):
            distance, d = math.dist(a, b), self.diameter_m
            if distance < (d if along[i, j] > BACK_COS else BACK_SHARE * d):
                cause = "their discs overlap" if along[i, j] > BACK_COS else "they are taken for one marker"
                raise ValueError(
                    f"markers {i} and {j} are {distance:.4g} m apart but {d:.4g} m in diameter: {cause}; "
                    "give all lengths in metres"
                )

    @property
    def is_single(self) -> bool:
        return len(self.markers) == 1

    @property
    def is_coded(self) -> bool:
        """Whether a code tells it from all other robots, and its markers from each other."""
        return any(self.codes)

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
        raise ConfigError(f"{path} declares no robot; {example_file('robots.yaml')} is an example")
    return robots


def load_saved_robots(path: Path) -> dict[str, Robot]:
    """Like `load_robots`, but accepts a file without robots: all may have been removed over the network."""
    robots = load_yaml(path, _Robots).robots
    require_trackable(robots, str(path))
    return robots


def save_robots(robots: dict[str, Robot], path: Path, first_line: str = "") -> None:
    """Write `robots.yaml` atomically, after a comment; raise ConfigError if the folder is not writable."""
    write_atomically(path, first_line + dump_yaml(_Robots(robots)))


def require_trackable(robots: dict[str, Robot], where: str, known: Collection[str] = ()) -> None:
    """Check robots; those of the `known` names were checked with each other before.

    Raises:
        ConfigError: a name is invalid, or there are too many robots or markers.
        FusionError: a constellation is symmetric, or two robots look alike.
    """
    _require_few(robots, where)
    if bad := [name for name in robots if not is_name(name)]:
        raise ConfigError(f"{where}: '{printable(bad[0], 80)}' can't name a robot; {NAME_RULE}")
    require_distinct(robots, where, known)


def _require_few(robots: dict[str, Robot], where: str) -> None:
    """Raise ConfigError for more robots or markers than can be tracked; before any work that grows with them."""
    n_markers = sum(len(robot.markers) for robot in robots.values())
    if len(robots) > MAX_ROBOTS or n_markers > MAX_ALL_MARKERS:
        raise ConfigError(
            f"{where}: {len(robots)} robots with {n_markers} markers; an arena has at most {MAX_ROBOTS} robots "
            f"with {MAX_ALL_MARKERS} markers; use another arena for the others"
        )


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
    _require_few(define, "the request")
    if unknown := next((name for name in (*rename, *remove) if name not in robots), None):
        names = ", ".join(robots) or "none"
        raise ConfigError(f"there is no robot '{printable(unknown, 80)}'; there are {printable(names)}")
    renamed = [rename.get(name, name) for name in robots]
    if taken := [name for name, count in Counter(renamed).items() if count > 1]:
        raise ConfigError(f"another robot has the name '{printable(taken[0], 80)}'; use a new name")
    removed = set(remove)
    remaining = {
        new: robot for new, (old, robot) in zip(renamed, robots.items(), strict=True) if old not in removed
    }
    existing = [name for name, robot in define.items() if remaining.get(name, robot) != robot]
    if existing and not replace:
        raise ConfigError(
            f"there is another robot '{existing[0]}': use another name, or confirm that it is replaced (--replace)"
        )
    all_robots = remaining | define
    unchanged = {name for name, robot in remaining.items() if all_robots[name] == robot}
    require_trackable(all_robots, "robots", unchanged)
    return all_robots


def require_distinct(robots: dict[str, Robot], where: str = "robots", known: Collection[str] = ()) -> None:
    """Raise FusionError if a robot has a rotational symmetry, or if two robots look alike.

    Robots of the `known` names are not compared with each other.
    """
    new = {name: robot for name, robot in robots.items() if name not in known}
    _require_own_codes(robots, where)
    for name, robot in new.items():
        if not robot.is_coded and (fault := symmetry(robot)):
            raise FusionError(f"{where}: robot '{name}' is {fault}")
    old = ((name, robots[name]) for name in robots if name in known)
    for (name_a, a), (name_b, b) in chain(combinations(new.items(), 2), product(old, new.items())):
        if fault := _confusion(a, b):
            raise FusionError(f"{where}: robots '{name_a}' and '{name_b}' are {fault}")


def _require_own_codes(robots: dict[str, Robot], where: str) -> None:
    """Raise FusionError if two robots have a code in common."""
    owner: dict[int, str] = {}
    for name, robot in robots.items():
        for code in filter(None, robot.codes):
            if (other := owner.setdefault(code, name)) != name:
                raise FusionError(
                    f"{where}: robots '{other}' and '{name}' have the same code {code}: nothing would tell them apart; "
                    "print another code for one of them"
                )


def _confusion(a: Robot, b: Robot) -> str | None:
    """Why two robots look alike; None if they differ."""
    if a.is_coded and b.is_coded:
        return None
    if max(a.diameter_m, b.diameter_m) > SIZES_DIFFER * min(a.diameter_m, b.diameter_m):
        return None
    if a.is_single and b.is_single:
        return _lack_of_starts(a, b, f"print one of them {SIZES_DIFFER:g} times as large")
    if a.is_single or b.is_single:
        return None  # acquisition resolves a single marker that belongs to a constellation
    if a.has_markers_of(b) and a.diameter_m == b.diameter_m:
        return _lack_of_starts(a, b, f"move a marker of one by {DISTINCT_M * 1e3:.0f} mm")
    fault = likeness(a, b)
    return fault and f"too alike: {fault}"


def _lack_of_starts(a: Robot, b: Robot, remedy: str) -> str | None:
    """Why two identical robots have no distinct starts; only their history distinguishes them."""
    if a.start_m and b.start_m and math.dist(a.start_m, b.start_m) >= APART_M:
        return None
    return f"identical: give both a start_m, {APART_M:g} m or more apart, or {remedy}"


def move_origin(robot: Robot, pivot_m: tuple[float, float, float]) -> Robot:
    """The robot with its origin at `pivot_m`, a point of its present frame, metres.

    Raises:
        FusionError: the point is not finite, or too far away.
    """
    if not all(abs(x) <= MAX_PIVOT_M for x in pivot_m):  # False for NaN
        raise FusionError(
            f"the pivot {pivot_m} is out of range; give metres, within {MAX_PIVOT_M:g} m of the robot"
        )
    return _with_markers(robot, robot.points - np.array(pivot_m), robot.unit_normals)


def turn_heading(robot: Robot, degrees: float) -> Robot:
    """The robot with its x axis turned about its z axis by `degrees`, counterclockwise seen from above.

    Raises:
        FusionError: the angle is not finite.
    """
    if not math.isfinite(degrees):
        raise FusionError(f"the angle {degrees} is no number of degrees")
    c, s = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    R_old_new = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    return _with_markers(robot, robot.points @ R_old_new, robot.unit_normals @ R_old_new)


def _with_markers(robot: Robot, points: Array, normals: Array) -> Robot:
    markers, directions = (
        tuple(map(tuple, (np.round(rows, DECIMALS) + 0.0).tolist())) for rows in (points, normals)
    )
    return msgspec.structs.replace(robot, markers=markers, normals=directions)
