# SPDX-License-Identifier: BSD-3-Clause
"""Joins the markers and the status of all zones, so that clients see one arena."""

from collections import Counter
from collections.abc import Collection, Iterable, Sequence

import msgspec
import numpy as np

from camera_node.foundation.arrays import Index
from fusion.protocol.pose_messages import MARKER_COLUMNS, FusionStatus, Markers


def markers_of_zone(markers: Markers, own_cameras: Collection[str]) -> Markers:
    """The markers without unlabeled ones that another zone reports: that of the first camera which sees them."""
    bits = markers.camera_bits()
    own = sum(1 << k for k, name in enumerate(markers.camera_names[:64]) if name in own_cameras)
    is_first_own = (bits & (~bits + np.uint64(1)) & np.uint64(own)) != 0
    kept = np.flatnonzero((markers.robot_index() >= 0) | is_first_own | (bits == 0))
    return markers if len(kept) == len(markers) else _select(markers, kept)


def join_markers(own: Markers, others: Iterable[Markers]) -> Markers:
    """The markers of all zones with the same robots and cameras as this one; the others follow a change, and join."""
    same = [m for m in others if (m.robots, m.camera_names) == (own.robots, own.camera_names)]
    columns = {name: b"".join(getattr(m, name) for m in (own, *same)) for name in MARKER_COLUMNS}
    return msgspec.structs.replace(own, **columns)


def _select(markers: Markers, rows: Index) -> Markers:
    columns = {}
    for name in MARKER_COLUMNS:
        table = np.frombuffer(getattr(markers, name), np.uint8).reshape(len(markers), -1)
        columns[name] = table[rows].tobytes()
    return msgspec.structs.replace(markers, **columns)


def status_of_zone(status: FusionStatus, own_cameras: Collection[str]) -> FusionStatus:
    """The status without cameras of other zones, which they report."""
    cameras = {name: health for name, health in status.cameras.items() if name in own_cameras}
    return msgspec.structs.replace(status, cameras=cameras)


def join_status(own: FusionStatus, others: Sequence[FusionStatus]) -> FusionStatus:
    """The status of all zones: their cameras and robots, the sums of faults, and the worst of the other figures."""
    every = (own, *others)
    robots = {name: state for status in every for name, state in status.robots.items()}
    latencies = [status.latency_ms for status in every if status.latency_ms is not None]
    missing = {name: why for status in reversed(every) for name, why in status.not_acquired.items()}
    return msgspec.structs.replace(
        own,
        frame_sets_per_s=min(status.frame_sets_per_s for status in every),
        latency_ms=max(latencies, default=None),
        cpu=max(status.cpu for status in every),
        memory_mb=max(status.memory_mb for status in every),
        cameras={name: health for status in every for name, health in status.cameras.items()},
        robots=robots,
        faults=dict(sum((Counter(status.faults) for status in every), Counter())),
        measured_diameters_m={k: v for status in every for k, v in status.measured_diameters_m.items()},
        not_acquired={k: why for k, why in missing.items() if robots.get(k) in (None, "lost")},
        contradictions=tuple(c for status in every for c in status.contradictions),
    )
