# SPDX-License-Identifier: BSD-3-Clause
"""A new robot out of markers that nobody knows, measured where it stands."""

import queue
import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import zenoh
from numpy.typing import ArrayLike
from scipy.optimize import linear_sum_assignment
from scipy.spatial.distance import cdist

from camera_node.arrays import Array
from camera_node.protocol.messages import Keys, MessageError, decode
from fusion.errors import FusionError
from fusion.model.robots import MotionModel, Robot
from fusion.protocol.messages import Markers

SAME_M = 0.02  # from one instant to the next: a marker that stands is no further off
REST_M = 0.005  # median distance from its place: more, and it does not stand
SEEN = 0.5  # share of the instants in which a marker that counts is seen
FLAT_M = 0.005  # markers within this of a plane tell where the robot's z points better than their prints do
OFF_CENTRE_M = 0.02  # the first marker that is so far from the middle shows where x points


@dataclass(frozen=True)
class Standing:
    """Markers that belong to nobody and stand: median positions (K, 3) and mean normals (K, 3), NaN where unknown.

    World, metres.
    """

    position: Array
    normal: Array

    def within(self, centre: ArrayLike, radius_m: float) -> "Standing":
        """Those no further than `radius_m` from a point (3,)."""
        near = np.linalg.norm(self.position - np.asarray(centre, float), axis=1) <= radius_m
        return Standing(self.position[near], self.normal[near])


def watch(session: zenoh.Session, arena: str, seconds: float) -> list[Markers]:
    """What a running server tells of markers in so many seconds; FusionError where that is nothing."""
    arrived: queue.Queue[bytes] = queue.Queue()
    subscriber = session.declare_subscriber(
        Keys(arena).markers, lambda sample: arrived.put(sample.payload.to_bytes())
    )
    end, instants = time.monotonic() + seconds, []
    try:
        while (left := end - time.monotonic()) > 0:
            try:
                instants.append(decode(arrived.get(timeout=left), Markers))
            except (queue.Empty, MessageError):
                continue
    finally:
        subscriber.undeclare()
    if not instants:
        raise FusionError(
            f"the server told of no instant in {seconds:g} s: are cameras running and calibrated?"
        )
    return instants


def find_standing(instants: Sequence[Markers]) -> Standing:
    """The markers without a robot that were seen in half of the instants or more, and stood there."""
    free = [_unlabelled(instant) for instant in instants]
    most = max(free, key=len, default=np.empty((0, 6)))
    seen = np.full((len(free), len(most), 6), np.nan)  # instants x markers x (position, normal)
    for row, there in zip(seen, free, strict=True):
        distance = cdist(most[:, :3], there[:, :3])
        mine, its = linear_sum_assignment(distance)
        same = distance[mine, its] < SAME_M
        row[mine[same]] = there[its[same]]
    often = np.isfinite(seen[:, :, 0]).mean(0) >= SEEN if len(free) else np.zeros(0, bool)
    seen = seen[:, often]
    if not often.any():
        return Standing(np.empty((0, 3)), np.empty((0, 3)))
    position = np.nanmedian(seen[..., :3], 0)
    off = np.nanmedian(np.linalg.norm(seen[..., :3] - position, axis=2), 0)
    seen, position = seen[:, off < REST_M], position[off < REST_M]
    return Standing(
        position, np.array([_mean_direction(seen[:, k, 3:]) for k in range(len(position))]).reshape(-1, 3)
    )


def robot_of(
    markers: Standing, diameter_m: float, motion: Literal["ground", "aerial"] | MotionModel = "aerial"
) -> Robot:
    """A robot with these markers: its origin in their middle, z out of the prints, x towards the first marker.

    Raises:
        FusionError: there are none, or no robot can have them.
    """
    if not len(markers.position):
        raise FusionError(
            "no marker of no robot stands there: hold the robot still where two cameras see it, with all markers up"
        )
    try:
        return Robot(diameter_m=diameter_m, markers=_in_body(markers), motion=motion)
    except ValueError as error:
        raise FusionError(f"these markers make no robot: {error}") from None


def _unlabelled(instant: Markers) -> Array:
    """(K, 6) positions and normals of markers that belong to no robot, and that more than one camera sees."""
    rows = np.hstack([instant.positions(), instant.normals().astype(float)])[instant.free()]
    return rows[np.isfinite(rows[:, :3]).all(1)]


def _mean_direction(normals: Array) -> Array:
    """(3,) of those (T, 3) that are known; NaN where none is."""
    known = normals[np.isfinite(normals).all(1)]
    total = known.sum(0)
    return total / np.linalg.norm(total) if np.any(total) else np.full(3, np.nan)


def _in_body(markers: Standing) -> tuple[tuple[float, float, float], ...]:
    """The positions in the robot's own frame, to a tenth of a millimetre."""
    at = markers.position - markers.position.mean(0)
    z = _up(at, markers.normal)
    flat = at - np.outer(at @ z, z)
    off = np.linalg.norm(flat, axis=1) >= OFF_CENTRE_M
    if not off.any():
        return ((0.0, 0.0, 0.0),) * len(at)  # one marker; of several in one place `Robot` knows what to say
    x = flat[np.argmax(off)] / np.linalg.norm(flat[np.argmax(off)])
    body = at @ np.column_stack([x, np.cross(z, x), z])
    x, y, z = np.round(body, 4).T.tolist()
    return tuple(zip(x, y, z, strict=True))


def _up(at: Array, normals: Array) -> Array:
    """Where prints face: along their plane's normal, else as the mean of theirs; upwards where none is known."""
    facing = _mean_direction(normals)
    known = np.isfinite(facing).all()
    _, _, axes = np.linalg.svd(at)
    flat = len(at) >= 3 and np.abs(at @ axes[2]).max() < FLAT_M
    if flat or not known:
        up = axes[2] if len(at) >= 3 else np.array([0.0, 0.0, 1.0])
        return -up if up @ (facing if known else [0.0, 0.0, 1.0]) < 0 else up
    return facing
