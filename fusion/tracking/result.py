# SPDX-License-Identifier: BSD-3-Clause
"""The result of tracking a frame set: poses, markers, and how many detections of each camera were used."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import compress
from typing import Any

import numpy as np
from numpy.typing import NDArray

from camera_node.foundation.arrays import Array, Index, Mask
from camera_node.geometry.pose import wxyz_from_rotation
from fusion.model.frames import FrameSet
from fusion.model.observations import Assignments, CameraArray, DetectionTable, MarkerTable
from fusion.model.states import States
from fusion.protocol.pose_messages import Latency, Markers, RobotPose, covariance_bytes
from fusion.tracking.estimator import Prediction
from fusion.tracking.named_markers import read_codes
from fusion.tracking.rays import Marker
from fusion.tracking.track_table import TrackTable
from fusion.tracking.unlabeled import UnlabeledMarkers

NO_SOLUTION = "frame set without a solution"
TOO_MANY_UNASSIGNED = "frame sets with more unassigned roundels than are searched at once"
MAX_CAMERAS = 64  # bits of the `cameras` column of `Markers`


@dataclass(frozen=True, slots=True, eq=False)
class CameraUse:
    """Numbers of used and unused detections of one camera, and the sum of squared residuals, px^2."""

    used: int
    unused: int
    squared_px: float


@dataclass(frozen=True, slots=True, eq=False)
class ObservationSummary:
    """Which cameras observed what.

    Attributes:
        robot_cameras: (R, C) robots and cameras.
        marker_cameras: (K, C) rows of the marker table and cameras.
        n_markers: (R,) observed markers.
        residual_px: (R,) RMS over all cameras; NaN without observations.
    """

    robot_cameras: Mask
    marker_cameras: Mask
    n_markers: Index
    residual_px: Array

    @classmethod
    def of(
        cls,
        cameras: CameraArray,
        marker_table: MarkerTable,
        n_robots: int,
        detections: DetectionTable,
        assignments: Assignments,
    ) -> "ObservationSummary":
        """Summarize the assignments of a frame set."""
        n_cameras = len(cameras.names)
        robot, camera = marker_table.robot[assignments.marker], detections.camera[assignments.detection]
        marker_cameras = np.zeros((len(marker_table), n_cameras), bool)
        marker_cameras[assignments.marker, camera] = True
        robot_cameras = np.zeros((n_robots, n_cameras), bool)
        robot_cameras[robot, camera] = True
        count = np.bincount(robot, minlength=n_robots)
        mean = np.bincount(robot, assignments.squared_px, n_robots) / np.where(count, count, np.nan)
        n_markers = np.bincount(marker_table.robot[marker_cameras.any(1)], minlength=n_robots)
        return cls(robot_cameras, marker_cameras, n_markers, np.sqrt(mean))


@dataclass(frozen=True, slots=True, eq=False)
class FilterStep:
    """One step of the filter, for the smoother.

    Attributes:
        states: after the observations.
        prediction: before the observations.
        continued: (R,) robots whose states follow from this prediction.
        rig: (R, 12, 12) covariances by the errors of the cameras, which filter and smoother leave out.
    """

    states: States
    prediction: Prediction
    continued: Mask
    rig: Array


@dataclass(frozen=True, slots=True, eq=False)
class TrackingResult:
    """The result of one frame set.

    Attributes:
        poses: of the robots of this server that were acquired at least once.
        markers: all markers, labeled and unlabeled; of the labeled ones those of its robots.
        cameras: by name.
        assignments: of the detections of all admitted cameras.
        summary: which cameras observed which robots.
        step: for the smoother.
        crowded: names of the cameras whose unassigned detections were too many to search all of them.
    """

    t_ns: int
    poses: tuple[RobotPose, ...]
    markers: Markers
    cameras: dict[str, CameraUse]
    assignments: Assignments
    summary: ObservationSummary
    step: FilterStep
    crowded: tuple[str, ...] = ()


def latency_of(frame_set: FrameSet, begun_ns: int, done_ns: int) -> Latency | None:
    """The latency since the newest exposure, by its parts; None for a frame set without frames."""
    newest = max(frame_set.frames, key=lambda frame: frame.t_ns, default=None)
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


def robot_poses(
    table: TrackTable, cameras: CameraArray, t_ns: int, summary: ObservationSummary, rows: list[int]
) -> dict[int, RobotPose]:
    """The poses by row of those robots in `rows` that this server publishes and that were acquired at least once."""
    if not rows:
        return {}
    states, names, status = table.states, cameras.names, table.status
    p, v, omega = _tuples(states.p), _tuples(states.v), _tuples(states.omega)
    wxyz, residual = _tuples(wxyz_from_rotation(states.R)), summary.residual_px.tolist()
    P, markers = covariance_bytes(table.claimed), summary.n_markers.tolist()
    owned, coded, seen_by, age_s = (
        table.owned.tolist(),
        table.coded.tolist(),
        summary.robot_cameras.tolist(),
        table.unseen_s(t_ns).tolist(),
    )
    return {
        k: RobotPose(
            robot=table.names[k],
            t_ns=t_ns,
            state=state,
            position=p[k],
            quaternion_wxyz=wxyz[k],
            velocity=v[k],
            angular_velocity=omega[k],
            covariance=P[576 * k : 576 * (k + 1)],
            n_markers=markers[k],
            cameras=tuple(compress(names, seen_by[k])),
            residual_px=residual[k] if markers[k] else None,
            evidence_age_s=age_s[k],
            body_markers=len(table.robots[k].markers),
            has_code=coded[k],
            acceleration_density=table.densities[k],
        )
        for k in rows
        if owned[k] and (state := status[k]) is not None
    }


def _tuples(rows: Array) -> list[tuple[Any, ...]]:
    """The rows of an array (N, M)."""
    return list(map(tuple, rows.tolist()))


def markers_message(
    table: TrackTable,
    cameras: CameraArray,
    t_ns: int,
    marker_cameras: Mask,
    unlabeled: UnlabeledMarkers,
    detections: DetectionTable,
) -> Markers:
    """The labeled markers at the poses of their robots, then the unlabeled ones.

    Args:
        table: robots, states and status.
        cameras: cameras of the rig.
        t_ns: time of the frame set.
        marker_cameras: (K, C) which camera observed which marker; rows without any are left out.
        unlabeled: the others.
        detections: of the frame set.
    """
    rows = np.flatnonzero(marker_cameras.any(1))
    none = np.full(len(unlabeled.markers), -1)
    (position, velocity, normal), covariance = table.marker_states(rows)
    no_candidates = np.full((len(rows), 2, 3), np.nan)
    codes, zeros = read_codes(cameras, detections, unlabeled.markers, unlabeled.normal)
    bits = np.array([_bits(marker.cameras) for marker in unlabeled.markers], np.uint64)
    return Markers(
        t_ns=t_ns,
        robots=table.names,
        camera_names=cameras.names,
        position=_column("<f8", position, unlabeled.position),
        covariance=_column("<f4", covariance, unlabeled.covariance),
        normal=_column("<f4", normal, unlabeled.normal),
        velocity=_column("<f4", velocity, unlabeled.velocity),
        diameter=_column(
            "<f4", np.full(len(rows), np.nan), np.array([m.diameter_m for m in unlabeled.markers])
        ),
        code=_column("<i4", np.zeros(len(rows)), codes),
        zero=_column("<f4", np.full((len(rows), 3), np.nan), zeros),
        robot=_column("<i4", table.markers.robot[rows], none),
        marker=_column("<i4", table.markers.number[rows], none),
        candidates=_column("<f4", no_candidates, unlabeled.candidates),
        cameras=_column("<u8", _packed(marker_cameras[rows]), bits),
    )


def camera_use(
    cameras: CameraArray, detections: DetectionTable, assignments: Assignments, unlabeled: Sequence[Marker]
) -> dict[str, CameraUse]:
    """Count the detections of each camera that robots and unlabeled markers use."""
    n, camera = len(cameras.names), detections.camera
    used = np.zeros(len(detections), bool)
    used[np.concatenate([assignments.detection, *(marker.detections for marker in unlabeled)])] = True
    n_used = np.bincount(camera[used], minlength=n).tolist()
    n_unused = np.bincount(camera[~used], minlength=n).tolist()
    of_assigned = camera[assignments.detection]
    squared_px = np.where(np.isnan(assignments.squared_px), 0.0, assignments.squared_px)
    squares = np.bincount(of_assigned, squared_px, n).tolist()
    return {name: CameraUse(n_used[k], n_unused[k], squares[k]) for k, name in enumerate(cameras.names)}


def _column(dtype: str, labeled: NDArray, unlabeled: NDArray) -> bytes:
    return np.concatenate([labeled, unlabeled]).astype(dtype).tobytes()


def _packed(seen: Mask) -> NDArray[np.uint64]:
    """(K,) bit masks of (K, C)."""
    of_bytes = np.packbits(seen[:, :MAX_CAMERAS], axis=1, bitorder="little")
    bits = np.zeros((len(seen), MAX_CAMERAS // 8), np.uint8)
    bits[:, : of_bytes.shape[1]] = of_bytes
    return bits.view("<u8")[:, 0]


def _bits(cameras: Index) -> int:
    return sum(1 << int(c) for c in set(cameras.tolist()) if c < MAX_CAMERAS)
