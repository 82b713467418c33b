# SPDX-License-Identifier: BSD-3-Clause
"""Measures a new robot: finds stationary unlabeled markers, and makes a constellation of them.

Where the measured normals of the markers differ by 45 degrees or more, the robot has markers on several sides, and each
marker has the normal of its side.
"""

import contextlib
import math
import queue
import time
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Literal

import msgspec
import numpy as np
import zenoh
from numpy.typing import ArrayLike

from camera_node.foundation.arrays import Array, Index, Mask
from camera_node.foundation.config import require_name
from camera_node.foundation.errors import ConfigError
from camera_node.geometry.body import Body
from camera_node.protocol.messages import Keys, MessageError, decode
from camera_node.protocol.requests import REQUEST_S, RequestSource
from fusion.errors import FusionError
from fusion.model.likeness import SIDE_COS, distances
from fusion.model.nearest import mutual_nearest
from fusion.model.robots import MotionModel, Robot
from fusion.protocol.pose_messages import Markers, Robots, RobotsRequest
from fusion.protocol.robot_requests import change_robots, request_robots

SAME_M = 0.02  # the largest distance of one stationary marker's positions in two messages
STATIONARY_M = 0.005  # the largest median distance of a stationary marker from its median position
MIN_SEEN = 0.5  # share of the messages that contain a marker that counts
# Between the given diameter and the one that is seen; beyond 0.2 a robot is never acquired.
MAX_SIZE_ERROR = 0.1
PLANAR_M = 0.005  # markers within this of a plane show the robot's z axis better than their normals
SIDES_RAD = math.radians(45)  # between normals of different sides; several sigma of a measured one
OFF_CENTRE_M = 0.02  # the first marker this far from the centre defines the x axis
# Columns of a marker that is measured.
PLACE, NORMAL, SIZE, CODE, ZERO, COLUMNS = slice(0, 3), slice(3, 6), 6, 7, slice(8, 11), 11
Rows = tuple[tuple[float, float, float], ...]
LONE = (
    "nothing but its size identifies a robot of one roundel: any other roundel of that size, or its image in a mirror, "
    "can be taken for it; remove or cover those, or use three roundels"
)
LOST_AT_RESTART = "a restart of the server loses it, because arena.yaml names no saved_robots"


@dataclass(frozen=True)
class StationaryMarkers:
    """Stationary unlabeled markers.

    Attributes:
        position, normal: (K, 3) medians, world, metres, and mean unit vectors, NaN where unknown.
        diameter_m: (K,) median of the discs as they appear, NaN where unknown.
        code: (K,) that was read, 0 for none.
        zero: (K, 3) mean unit vectors to the zeros of the codes, world, NaN where unknown.
    """

    position: Array
    normal: Array
    diameter_m: Array
    code: Index
    zero: Array

    @classmethod
    def of(cls, seen: Array) -> "StationaryMarkers":
        """The markers of rows (T, K, 11) as `_unlabeled` gives them, NaN in messages without the marker."""
        directions = [
            [_mean_direction(seen[:, k, at]) for k in range(seen.shape[1])] for at in (NORMAL, ZERO)
        ]
        normal, zero = (np.array(vectors).reshape(-1, 3) for vectors in directions)
        sizes = np.array([_median_known(seen[:, k, SIZE]) for k in range(seen.shape[1])])
        codes = np.array([_only_code(seen[:, k, CODE]) for k in range(seen.shape[1])], np.intp)
        return cls(np.nanmedian(seen[..., PLACE], 0), normal, sizes, codes, zero)

    def select(self, rows: Index | Mask) -> "StationaryMarkers":
        """The markers of a mask or an index array."""
        return StationaryMarkers(
            self.position[rows], self.normal[rows], self.diameter_m[rows], self.code[rows], self.zero[rows]
        )

    def within(self, centre: ArrayLike, radius_m: float) -> "StationaryMarkers":
        """The markers within `radius_m` of a point (3,)."""
        near = np.linalg.norm(self.position - np.asarray(centre, float), axis=1) <= radius_m
        return self.select(near)


def collect_markers(session: zenoh.Session, arena: str, seconds: float) -> list[Markers]:
    """Messages of a running server that contain unlabeled markers, from the first one until one `seconds` later.

    A busy machine fuses fewer frames, and of some only those of one camera, which locate no marker: such messages say
    nothing about markers that stand still, and are left out.

    Returns:
        The messages; none if for `REQUEST_S` none contained an unlabeled marker.

    Raises:
        FusionError: the server publishes no markers at all.
    """
    received: queue.Queue[bytes] = queue.Queue()
    subscriber = session.declare_subscriber(
        Keys(arena).markers, lambda sample: received.put(sample.payload.to_bytes())
    )
    latest_s, is_silent = time.monotonic(), True
    first_s, messages = math.inf, []
    try:
        while latest_s - first_s < seconds:
            if (left := latest_s + REQUEST_S - time.monotonic()) <= 0:
                messages.clear()
                break
            with contextlib.suppress(queue.Empty, MessageError):
                message = decode(received.get(timeout=left), Markers)
                is_silent = False
                if len(_unlabeled(message)):
                    latest_s = time.monotonic()
                    first_s = min(first_s, latest_s)
                    messages.append(message)
    finally:
        subscriber.undeclare()
    if is_silent:
        raise FusionError(
            f"the server published no markers within {REQUEST_S:g} s; are cameras running and calibrated?"
        )
    return messages


def find_stationary_markers(messages: Sequence[Markers]) -> StationaryMarkers:
    """The unlabeled markers that half of the messages or more contain, at one place.

    A marker that some message labels is that of a robot which the server loses for moments, as on a busy machine.
    """
    unlabeled = [_unlabeled(message) for message in messages]
    reference = max(unlabeled, key=len, default=np.empty((0, COLUMNS)))
    seen = np.full((len(unlabeled), len(reference), COLUMNS), np.nan)
    for row, markers in zip(seen, unlabeled, strict=True):
        ours, theirs = mutual_nearest(reference[:, PLACE], markers[:, PLACE], SAME_M)
        row[ours] = markers[theirs]
    seen = seen[:, np.isfinite(seen[:, :, 0]).sum(0) >= max(1, MIN_SEEN * len(seen))]
    if not seen.size:
        return StationaryMarkers.of(np.empty((1, 0, COLUMNS)))
    spread = np.nanmedian(np.linalg.norm(seen[..., PLACE] - np.nanmedian(seen[..., PLACE], 0), axis=2), 0)
    markers = StationaryMarkers.of(seen[:, spread < STATIONARY_M])
    labeled = np.vstack([message.positions()[message.robot_index() >= 0] for message in messages])
    off = np.linalg.norm(markers.position[:, None] - labeled, axis=2)
    return markers.select(~(off < SAME_M).any(1))


def robot_from_markers(
    markers: StationaryMarkers,
    diameter_m: float,
    motion: Literal["ground", "aerial"] | MotionModel = "aerial",
) -> Robot:
    """A robot with these markers: its origin is their mean, z is out of the prints, x towards the first marker.

    Of a robot with markers on several sides, z is out of the uppermost side. Of one with codes, x is
    towards the zero of the first one.

    Raises:
        FusionError: there are no markers, they have another diameter, no robot can have them, or the normal of one of
            several sides is unknown.
    """
    if not len(markers.position):
        raise FusionError(
            "no stationary unlabeled marker found there; hold the robot still, with all markers up, in view of two "
            "cameras"
        )
    seen_m = _median_known(markers.diameter_m)
    if abs(diameter_m / seen_m - 1) > MAX_SIZE_ERROR:
        raise FusionError(
            f"the black discs measure about {1e3 * seen_m:.0f} mm, not {1e3 * diameter_m:.0f} mm; give their diameter, "
            "or correct the lengths in wand.yaml and calibrate again if a ruler confirms it"
        )
    try:
        positions, normals = _in_body(markers)
        codes = tuple(markers.code.tolist()) if markers.code.any() else ()
        code = codes[0] if len(codes) == 1 else codes
        return Robot(diameter_m=diameter_m, markers=positions, normals=normals, motion=motion, code=code)
    except ValueError as error:
        raise FusionError(f"these markers make no robot: {error}") from None


def _unlabeled(message: Markers) -> Array:
    """(K, 11) positions, normals, diameters, codes and zeros of unlabeled markers that two or more cameras see."""
    alone = message.diameters()[:, None], message.codes()[:, None]
    columns = message.positions(), message.normals(), *alone, message.zeros()
    rows = np.hstack(columns).astype(float)[message.unlabeled()]
    return rows[np.isfinite(rows[:, PLACE]).all(1)]


def _median_known(values: Array) -> float:
    """The median of the values (N,) that are not NaN; NaN if none is."""
    known = values[np.isfinite(values)]
    return float(np.median(known)) if len(known) else np.nan


def _only_code(codes: Array) -> int:
    """The code among those that were read (T,), 0 or NaN where none was; 0 unless all are the same."""
    read = np.unique(codes[codes > 0])
    return int(read[0]) if len(read) == 1 else 0


def _mean_direction(normals: Array) -> Array:
    """(3,) mean direction of the normals (T, 3) that are known; NaN where none is."""
    known = normals[np.isfinite(normals).all(1)]
    total = known.sum(0)
    return total / np.linalg.norm(total) if np.any(total) else np.full(3, np.nan)


def _in_body(markers: StationaryMarkers) -> tuple[Rows, Rows]:
    """Positions, to a tenth of a millimetre, and normals in the robot's own frame; no normals if all are +z."""
    centred = markers.position - markers.position.mean(0)
    normals = _normals_of_sides(centred, markers.normal)
    z = _z_axis(centred, markers.normal) if normals is None else normals[np.argmax(normals[:, 2])]
    flat = centred - np.outer(centred @ z, z)
    off = np.linalg.norm(flat, axis=1) >= OFF_CENTRE_M
    if not off.any():
        return ((0.0, 0.0, 0.0),) * len(centred), ()  # one marker; `Robot` refuses several in one place
    x = _x_axis(markers, z, flat[np.argmax(off)])
    R_world_body = np.asarray(np.column_stack([x, np.cross(z, x), z]), float)
    return _rows(centred @ R_world_body), () if normals is None else _rows(normals @ R_world_body)


def _x_axis(markers: StationaryMarkers, z: Array, to_marker: Array) -> Array:
    """(3,) perpendicular to z: to the zero of the first code whose print faces z, else along `to_marker`."""
    for zero, normal, code in zip(markers.zero, markers.normal, markers.code, strict=True):
        across = zero - (zero @ z) * z
        if code and np.isfinite(zero).all() and not normal @ z < SIDE_COS:
            return across / np.linalg.norm(across)
    return to_marker / np.linalg.norm(to_marker)


def _rows(vectors: Array) -> Rows:
    x, y, z = (np.round(vectors, 4) + 0.0).T.tolist()
    return tuple(zip(x, y, z, strict=True))


def _normals_of_sides(centred: Array, normals: Array) -> Array | None:
    """(K, 3) the normals of the sides that the markers are on; None if all markers face one way.

    Three markers or more in one plane show the normal of their side better than their outlines do.

    Raises:
        FusionError: there are several sides, and a normal is unknown.
    """
    is_known = np.isfinite(normals).all(1)
    known = normals[is_known]
    if not len(known) or (known @ known.T).min() > math.cos(SIDES_RAD):
        return None
    if not is_known.all():
        raise FusionError(
            f"the markers are on several sides, and the normals of {int((~is_known).sum())} of {len(normals)} are not "
            "known: turn the robot, or let more cameras see it, so that two cameras see each marker from different "
            "directions"
        )
    result = np.full_like(normals, np.nan)
    while len(rows := np.flatnonzero(np.isnan(result[:, 0]))):
        side = rows[normals[rows] @ normals[rows[0]] > math.cos(SIDES_RAD / 2)]
        mean = _mean_direction(normals[side])
        result[side] = _plane_normal(centred[side], mean)
    return result


def _plane_normal(points: Array, facing: Array) -> Array:
    """(3,) the normal of planar points (N, 3) on the side of the unit vector `facing`; `facing` if they are not."""
    _, spread, axes = np.linalg.svd(points - points.mean(0))
    is_plane = len(points) >= 3 and spread[1] > OFF_CENTRE_M and spread[2] < PLANAR_M
    return axes[2] * np.sign(axes[2] @ facing) if is_plane else facing


def _z_axis(centred: Array, normals: Array) -> Array:
    """(3,) the plane's normal if the markers are planar, else their mean normal; upwards where no normal is known."""
    facing = _mean_direction(normals)
    is_known = np.isfinite(facing).all()
    _, _, axes = np.linalg.svd(centred)
    is_planar = len(centred) >= 3 and np.abs(centred @ axes[2]).max() < PLANAR_M
    if is_planar or not is_known:
        z = axes[2] if len(centred) >= 3 else np.array([0.0, 0.0, 1.0])
        return -z if z @ (facing if is_known else [0.0, 0.0, 1.0]) < 0 else z
    return facing


@dataclass(frozen=True)
class RobotDefinition:
    """What the user specifies about a robot.

    Attributes:
        name: the robot's name.
        diameter_m: of its roundels' black discs.
        motion: how it moves.
        centre: its rough position, world, metres; None if it has all unlabeled markers.
        radius_m: the largest distance of its markers from there.
        replace: whether it may replace a robot of that name.

    Raises:
        ConfigError: the name can't be one, or the diameter is not plausible.
    """

    name: str
    diameter_m: float
    motion: Literal["ground", "aerial"] = "aerial"
    centre: tuple[float, float, float] | None = None
    radius_m: float = 0.3
    replace: bool = False

    def __post_init__(self) -> None:
        require_name(self.name, "a robot")
        try:
            Body(diameter_m=self.diameter_m, markers=((0.0, 0.0, 0.0),))
        except ValueError as error:
            raise ConfigError(str(error)) from None


def define_robot(session: zenoh.Session, arena: str, definition: RobotDefinition, seconds: float) -> Robots:
    """Measure a robot for `seconds`, and add it to the robots of the running server, which it returns.

    Raises:
        ConfigError: there is a robot of that name.
        FusionError: the markers make no robot, or the server refuses it.
        NetworkError: no server answers in time.
    """
    existing = request_robots(session, arena).robots  # fails without a server, before the measurement
    if definition.name in existing and not definition.replace:
        raise ConfigError(f"there is another robot '{definition.name}': add --replace, or use another name")
    markers = find_stationary_markers(collect_markers(session, arena, seconds))
    if definition.centre is not None:
        markers = markers.within(definition.centre, definition.radius_m)
    robot = robot_from_markers(markers, definition.diameter_m, definition.motion)
    source = RequestSource.of("roundel define")
    request = RobotsRequest(define={definition.name: robot}, replace=definition.replace, source=source)
    return change_robots(session, arena, request)


def describe(name: str, robots: Robots) -> str:
    """The measured robot in words, and as an entry for robots.yaml."""
    robot = robots.robots[name]
    D = distances(robot.points)
    pairs = ", ".join(f"{i}-{j} {D[i, j] * 1e3:.1f}" for i, j in combinations(range(len(D)), 2))
    defined = f"the server now tracks {name}, with {len(D)} marker{'s' * (len(D) > 1)}"
    entry = msgspec.json.encode({name: robot}).decode()[1:-1].replace('":', '": ').replace(",", ", ")
    notes = (f"; {LOST_AT_RESTART}" if name in robots.unsaved else "") + (
        f"; {LONE}" if robot.is_single and not robot.is_coded else ""
    )
    return f"{defined}{f' (distances in mm: {pairs})' if pairs else ''}{notes}; for robots.yaml:\n  {entry}"
