# SPDX-License-Identifier: BSD-3-Clause
"""Frames of different cameras that were taken close in time. Cameras fire when they like; each keeps its own time."""

from collections.abc import Sequence

import numpy as np

from calib.views import View
from camera_node.messages import Detections

MAX_SPREAD_NS = 100_000_000  # a hand moves decimetres in this time


def frame_period_ns(messages: Sequence[Detections]) -> int:
    """The median time from one frame of a camera to its next, over all cameras; 0 where no camera has two."""
    times: dict[str, list[int]] = {}
    for message in messages:
        times.setdefault(message.camera, []).append(message.t_ns)
    steps = [np.diff(np.unique(t)) for t in times.values() if len(t) > 1]
    return int(np.median(np.concatenate(steps))) if steps and len(np.concatenate(steps)) else 0


def group_instants(views: Sequence[View], period_ns: int) -> list[list[View]]:
    """Instants: runs of views, each camera at most once, within half of a frame period; two cameras or more."""
    spread = min(period_ns // 2 + 1, MAX_SPREAD_NS) if period_ns else MAX_SPREAD_NS
    instants: list[list[View]] = []
    for view in sorted(views, key=lambda view: (view.t_ns, view.camera)):
        current = instants[-1] if instants else None
        full = current is None or any(other.camera == view.camera for other in current)
        if current is None or full or view.t_ns - current[0].t_ns > spread:
            instants.append([view])
        else:
            current.append(view)
    return [instant for instant in instants if len(instant) >= 2]
