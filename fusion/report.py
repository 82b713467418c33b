# SPDX-License-Identifier: BSD-3-Clause
"""What an instant tells the world: poses, markers, and how much of each camera was of use."""

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from camera_node.pose import wxyz_from_rotation
from fusion.association import Catalogue, Matches, Sightings
from fusion.estimator import Estimator, Observations
from fusion.grouping import Marker
from fusion.instants import Instant
from fusion.messages import Markers, RobotPose, State
from fusion.optics import Optics
from fusion.state import States, skew

Array = NDArray[np.float64]
Index = NDArray[np.intp]


class Told(Protocol):
    """What a report needs of a tracker: its robots' names, states and status, and what they are seen by."""

    names: tuple[str, ...]
    optics: Optics
    catalogue: Catalogue
    estimator: Estimator
    states: States
    status: list[State | None]


@dataclass(frozen=True, slots=True, eq=False)
class CameraUse:
    """What an instant used of one camera: detections used and unused, and the sum of squared residuals, px^2."""

    used: int
    unused: int
    squared_px: float


@dataclass(frozen=True, slots=True, eq=False)
class Fused:
    """What an instant tells."""

    t_ns: int
    poses: tuple[RobotPose, ...]
    markers: Markers
    cameras: dict[str, CameraUse]


def report(
    tracker: Told, instant: Instant, sightings: Sightings, matches: Matches, free: list[Marker]
) -> Fused:
    observations = matches.observations(sightings, tracker.catalogue)
    error, _ = tracker.estimator.errors(tracker.states, observations)
    squared = np.sum(error**2, 1)
    poses = tuple(
        _pose(tracker, k, instant.t_ns, matches, observations, squared)
        for k, status in enumerate(tracker.status)
        if status is not None
    )
    markers = _markers(tracker, instant.t_ns, matches, observations, free)
    return Fused(instant.t_ns, poses, markers, _usage(tracker, sightings, matches, free, squared))


def _pose(
    tracker: Told, k: int, t_ns: int, matches: Matches, observations: Observations, squared: Array
) -> RobotPose:
    mine = observations.discs.body == k
    cameras = np.unique(observations.discs.camera[mine])
    status = tracker.status[k]
    assert status is not None
    return RobotPose(
        robot=tracker.names[k],
        t_ns=t_ns,
        state=status,
        position=tuple(tracker.states.p[k].tolist()),
        quaternion_wxyz=tuple(wxyz_from_rotation(tracker.states.R[k]).tolist()),
        velocity=tuple(tracker.states.v[k].tolist()),
        angular_velocity=tuple(tracker.states.omega[k].tolist()),
        covariance=tracker.states.P[k].astype("<f4").tobytes(),
        n_markers=len(np.unique(matches.disc[mine])),
        cameras=tuple(tracker.optics.names[c] for c in cameras),
        residual_px=float(np.sqrt(squared[mine].mean())) if mine.any() else None,
    )


def _markers(
    tracker: Told, t_ns: int, matches: Matches, observations: Observations, free: list[Marker]
) -> Markers:
    """Labelled markers where their robots put them, then those that are nobody's."""
    discs = np.unique(matches.disc)
    owner = tracker.catalogue.robot[discs]
    R, marker = tracker.states.R[owner], tracker.catalogue.marker[discs]
    arm = -R @ skew(marker)
    J = np.concatenate([arm, np.tile(np.eye(3), (len(discs), 1, 1))], 2)
    labelled = J @ tracker.states.P[owner][:, :6, :6] @ J.transpose(0, 2, 1)
    bits = [_bits(observations.discs.camera[matches.disc == d]) for d in discs]
    none = np.full(len(free), -1)
    position = [*(tracker.states.p[owner] + np.einsum("nij,nj->ni", R, marker)), *(m.position for m in free)]
    covariance = [*labelled, *(m.covariance for m in free)]
    normal = [*R[:, :, 2], *(np.full(3, np.nan) for _ in free)]
    return Markers(
        t_ns=t_ns,
        robots=tracker.names,
        camera_names=tracker.optics.names,
        position=np.array(position).astype("<f8").tobytes(),
        covariance=np.array(covariance).astype("<f4").tobytes(),
        normal=np.array(normal).astype("<f4").tobytes(),
        robot=np.concatenate([owner, none]).astype("<i4").tobytes(),
        marker=np.concatenate([tracker.catalogue.number[discs], none]).astype("<i4").tobytes(),
        cameras=np.array([*bits, *(_bits(m.cameras) for m in free)], "<u8").tobytes(),
    )


def _usage(
    tracker: Told, sightings: Sightings, matches: Matches, free: list[Marker], squared: Array
) -> dict[str, CameraUse]:
    used = np.isin(
        np.arange(len(sightings)), np.concatenate([matches.sighting, *(m.sightings for m in free)])
    )
    n = len(tracker.optics.names)
    taken = np.bincount(sightings.camera[used], minlength=n)
    unused = np.bincount(sightings.camera[~used], minlength=n)
    squares = np.bincount(sightings.camera[matches.sighting], squared, minlength=n)
    return {
        name: CameraUse(int(taken[k]), int(unused[k]), float(squares[k]))
        for k, name in enumerate(tracker.optics.names)
    }


def _bits(cameras: Index) -> int:
    return sum(1 << int(c) for c in np.unique(cameras))
