# SPDX-License-Identifier: BSD-3-Clause
"""What an instant tells the world: poses, markers, and how much of each camera was of use."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import compress
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from calib.rig.camera import Camera
from camera_node.arrays import Array, Index, Mask
from camera_node.geometry.pose import wxyz_from_rotation
from fusion._core import ExpectedMarkers
from fusion.model.camera_array import CameraArray
from fusion.model.frames import FrameSet
from fusion.model.observations import Assignments, DetectionTable, MarkerTable
from fusion.model.states import States
from fusion.protocol.messages import Latency, Markers, RobotPose, TrackingState
from fusion.protocol.shards import Shard
from fusion.tracking.multiview import Marker
from fusion.tracking.unlabeled import UnlabeledMarkers


class Told(Protocol):
    """What a report needs of a tracker: its robots' names, states and status, and what they are seen by."""

    names: tuple[str, ...]
    optics: CameraArray
    catalogue: MarkerTable
    states: States
    status: list[TrackingState | None]
    owned: Mask  # robots whose poses are told
    shard: Shard


@dataclass(frozen=True, slots=True, eq=False)
class CameraUse:
    """What an instant used of one camera: detections used and unused, and the sum of squared residuals, px^2."""

    used: int
    unused: int
    squared_px: float


@dataclass(frozen=True, slots=True, eq=False)
class Move:
    """A camera was found to be moved: where it stands now, or None while its detections are set aside."""

    name: str
    camera: Camera | None


@dataclass(frozen=True, slots=True, eq=False)
class Fused:
    """What an instant tells."""

    t_ns: int
    poses: tuple[RobotPose, ...]
    markers: Markers
    cameras: dict[str, CameraUse]


@dataclass(frozen=True, slots=True, eq=False)
class Seen:
    """What was used of every robot: by robot and camera (B, C), by marker of the catalogue and camera (K, C)."""

    by_robot: Mask
    by_marker: Mask
    n_markers: Index  # (B,)
    residual_px: Array  # (B,) RMS, NaN without observations


def report(
    tracker: Told,
    instant: FrameSet,
    sightings: DetectionTable,
    matches: Assignments,
    seen: Seen,
    free: UnlabeledMarkers,
    told: dict[int, RobotPose],
) -> Fused:
    """What to tell of an instant after its observations; the poses in `told`, by robot, stay as they were told.

    Markers are told by the leading shard alone.
    """
    rest = [k for k in np.flatnonzero(tracker.owned).tolist() if k not in told]
    poses = told | tell_poses(tracker, instant.t_ns, seen, rest)
    markers = _markers(tracker, instant.t_ns, seen, free)
    usage = _usage(tracker, sightings, matches, free.markers)
    return Fused(instant.t_ns, tuple(poses[k] for k in sorted(poses)), markers, usage)


def latency_of(instant: FrameSet, begun_ns: int, done_ns: int) -> Latency | None:
    """Where the time went since the newest exposure; None for an instant without frames."""
    newest = max(instant.frames, key=lambda frame: frame.t_ns, default=None)
    if newest is None:
        return None
    sent_ns = newest.sent_ns or newest.received_ns
    return Latency(
        exposure_ms=newest.exposure_us / 2e3,
        detect_ms=newest.detect_us * 1e-3,
        camera_ms=(sent_ns - newest.t_ns) * 1e-6,
        network_ms=(newest.received_ns - sent_ns) * 1e-6,
        wait_ms=(begun_ns - newest.received_ns) * 1e-6,
        fuse_ms=(done_ns - begun_ns) * 1e-6,
        total_ms=(done_ns - newest.t_ns) * 1e-6,
    )


def look(tracker: Told, sightings: DetectionTable, matches: Assignments) -> Seen:
    """See `Seen`."""
    robots, cameras = len(tracker.names), len(tracker.optics.names)
    body, camera = tracker.catalogue.robot[matches.disc], sightings.camera[matches.sighting]
    by_robot = np.zeros((robots, cameras), bool)
    by_marker = np.zeros((len(tracker.catalogue.robot), cameras), bool)
    by_robot[body, camera] = by_marker[matches.disc, camera] = True
    count = np.bincount(body, minlength=robots)
    mean = np.bincount(body, matches.squared_px, robots) / np.where(count, count, np.nan)
    n_markers = np.bincount(tracker.catalogue.robot[by_marker.any(1)], minlength=robots)
    return Seen(by_robot, by_marker, n_markers, np.sqrt(mean))


def tell_poses(tracker: Told, t_ns: int, seen: Seen, rows: list[int]) -> dict[int, RobotPose]:
    """The poses of those of the robots `rows` that are this shard's and have a status, by robot."""
    if not rows:
        return {}
    states, names, status = tracker.states, tracker.optics.names, tracker.status
    p, v, omega = states.p.tolist(), states.v.tolist(), states.omega.tolist()
    wxyz, residual = wxyz_from_rotation(states.R).tolist(), seen.residual_px.tolist()
    P, markers = states.P.astype("<f4").tobytes(), seen.n_markers.tolist()
    owned, by_robot = tracker.owned.tolist(), seen.by_robot.tolist()
    return {
        k: RobotPose(
            robot=tracker.names[k],
            t_ns=t_ns,
            state=state,
            position=tuple(p[k]),
            quaternion_wxyz=tuple(wxyz[k]),
            velocity=tuple(v[k]),
            angular_velocity=tuple(omega[k]),
            covariance=P[576 * k : 576 * (k + 1)],
            n_markers=markers[k],
            cameras=tuple(compress(names, by_robot[k])),
            residual_px=residual[k] if markers[k] else None,
        )
        for k in rows
        if owned[k] and (state := status[k]) is not None
    }


def _stand(tracker: Told, discs: Index) -> tuple[Array, Array]:
    """Of markers of the catalogue: the arms (K, 3) from their robots' origins and their places' covariances (K, 3, 3),
    both in the world."""
    owner, marker = tracker.catalogue.robot[discs], tracker.catalogue.marker.take(discs, 1)
    places = ExpectedMarkers(
        tracker.states.R, tracker.states.P, owner, marker, tracker.catalogue.radius[discs]
    )
    return np.einsum("nij,jn->ni", tracker.states.R[owner], marker), places.covariances(0.0)


def followed_places(tracker: Told) -> tuple[Array, Array]:
    """(K, 3) and (K, 3, 3) all markers of the robots that are tracked or coasting, seen or not."""
    alive = np.array([status in ("tracked", "coasting") for status in tracker.status], bool)
    discs = np.flatnonzero(alive[tracker.catalogue.robot])
    arm, covariance = _stand(tracker, discs)
    return tracker.states.p[tracker.catalogue.robot[discs]] + arm, covariance


def _markers(tracker: Told, t_ns: int, seen: Seen, free: UnlabeledMarkers) -> Markers:
    """Labelled markers where their robots put them, then those that are nobody's."""
    discs = np.flatnonzero(seen.by_marker.any(1) & tracker.shard.leads)
    states, none = tracker.states, np.full(len(free.markers), -1)
    owner = tracker.catalogue.robot[discs]
    omega, (arm, covariance) = states.omega[owner], _stand(tracker, discs)
    turning = omega[:, [1, 2, 0]] * arm[:, [2, 0, 1]] - omega[:, [2, 0, 1]] * arm[:, [1, 2, 0]]
    free_bits = np.array([_bits(m.cameras) for m in free.markers], np.uint64)
    return Markers(
        t_ns=t_ns,
        robots=tracker.names,
        camera_names=tracker.optics.names,
        position=np.concatenate([states.p[owner] + arm, free.position]).astype("<f8").tobytes(),
        covariance=np.concatenate([covariance, free.covariance]).astype("<f4").tobytes(),
        normal=np.concatenate([states.R[owner][:, :, 2], free.normal]).astype("<f4").tobytes(),
        velocity=np.concatenate([states.v[owner] + turning, free.velocity]).astype("<f4").tobytes(),
        robot=np.concatenate([owner, none]).astype("<i4").tobytes(),
        marker=np.concatenate([tracker.catalogue.number[discs], none]).astype("<i4").tobytes(),
        candidates=np.concatenate([np.full((len(discs), 2, 3), np.nan), free.candidates])
        .astype("<f4")
        .tobytes(),
        cameras=np.concatenate([_packed(seen.by_marker[discs]), free_bits]).astype("<u8").tobytes(),
    )


def _usage(
    tracker: Told, sightings: DetectionTable, matches: Assignments, free: Sequence[Marker]
) -> dict[str, CameraUse]:
    n, camera = len(tracker.optics.names), sightings.camera
    used = np.zeros(len(sightings), bool)
    used[np.concatenate([matches.sighting, *(m.sightings for m in free)])] = True
    taken = np.bincount(camera[used], minlength=n).tolist()
    unused = np.bincount(camera[~used], minlength=n).tolist()
    squares = np.bincount(camera[matches.sighting], np.nan_to_num(matches.squared_px), n).tolist()
    return {name: CameraUse(taken[k], unused[k], squares[k]) for k, name in enumerate(tracker.optics.names)}


def _packed(seen: Mask) -> NDArray[np.uint64]:
    """(K,) the bits of (K, C)."""
    return seen[:, :64].astype(np.uint64) @ (
        np.uint64(1) << np.arange(min(seen.shape[1], 64), dtype=np.uint64)
    )


def _bits(cameras: Index) -> int:
    return sum(1 << int(c) for c in set(cameras.tolist()) if c < 64)
