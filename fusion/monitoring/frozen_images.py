# SPDX-License-Identifier: BSD-3-Clause
"""Recognizes cameras whose images do not change although robots move: a driver that repeats its last frame.

The noise of a live image never repeats exactly. A simulated image without noise repeats while the scene rests, so
identical detections count only once a robot that they show has moved.
"""

import logging
import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from camera_node.foundation.arrays import Array, Index
from camera_node.foundation.logs import about
from fusion.model.expected_views import ExpectedViews
from fusion.model.frames import CalibratedFrame
from fusion.model.observations import CameraArray, MarkerTable
from fusion.model.states import Snapshot
from fusion.model.undistortion import COV, UV

log = logging.getLogger("fusion")
SEEN_PX = 2.0  # between an expected and a detected roundel
DETECTED = slice(UV.start, COV.stop)  # centres and their covariances
MOVED_PX = 1.5  # by which a marker moved that the image still shows at its old place


@dataclass(slots=True)
class _Run:
    """Identical frames of a camera: the first one, and where (N, 2) it shows which markers (rows)."""

    first: CalibratedFrame
    rows: Index | None = None
    uv: Array | None = None
    is_frozen: bool = False


class FrozenImages:
    """The cameras of a rig, each with its last run of identical frames.

    Args:
        cameras: cameras of the rig.
        markers: of all robots.
    """

    def __init__(self, cameras: CameraArray, markers: MarkerTable) -> None:
        self._cameras, self._markers = cameras, markers
        self._runs: dict[str, _Run] = {}

    @property
    def names(self) -> set[str]:
        """Cameras whose images are frozen."""
        return {name for name, run in self._runs.items() if run.is_frozen}

    def inherit(self, old: "FrozenImages") -> None:
        """Continue with the same cameras and other robots."""
        self._runs = {name: _Run(run.first, is_frozen=run.is_frozen) for name, run in old._runs.items()}

    def is_frozen(self, frame: CalibratedFrame, robots_now: Callable[[], Snapshot | None]) -> bool:
        """Whether the image of this frame is an old one; logs when that begins and ends.

        Args:
            frame: the next one of its camera.
            robots_now: the robots at the last frame set; None before the first. Called if images are identical.
        """
        name, run = frame.camera, self._runs.get(frame.camera)
        if run is None or not _are_identical(run.first, frame):
            if run is not None and run.is_frozen:
                log.info("camera %s delivers new images again", name, extra=about(name))
            self._runs[name] = _Run(frame)
            return False
        now = robots_now()
        moved = self._has_moved(run, frame, now) if now is not None else None
        if moved and not run.is_frozen:
            at = time.strftime("%H:%M:%S", time.localtime(run.first.t_ns * 1e-9))
            message = (
                "camera %s repeats its image of %s: excluded until it delivers new ones; restart its driver"
            )
            log.warning(message, name, at, extra=about(name))
        run.is_frozen = run.is_frozen if moved is None else moved
        return run.is_frozen

    def _has_moved(self, run: _Run, frame: CalibratedFrame, now: Snapshot) -> bool | None:
        """Whether a marker that the run shows is elsewhere by now; None if no robot tells."""
        if run.rows is None or run.uv is None:
            rows = np.flatnonzero(now.tracked[self._markers.robot])
            expected = self._expected(run.first, now, rows)
            seen = _distances(expected.uv, run.first.columns[UV].T) < SEEN_PX
            run.rows, run.uv = expected.rows[seen], expected.uv[seen]
        expected = self._expected(frame, now, run.rows[now.tracked[self._markers.robot[run.rows]]])
        before = run.uv[np.isin(run.rows, expected.rows)]
        if not len(before):
            return None
        return bool((np.linalg.norm(expected.uv - before, axis=1) > MOVED_PX).any())

    def _expected(self, frame: CalibratedFrame, now: Snapshot, rows: Index) -> ExpectedViews:
        tau = (frame.t_ns - now.t_ns) * 1e-9
        return ExpectedViews.of(self._cameras, frame.camera, now.states, tau, (self._markers, rows))


def _are_identical(a: CalibratedFrame, b: CalibratedFrame) -> bool:
    """Whether there are detections, and all have the same centres and covariances."""
    before, now = a.columns[DETECTED], b.columns[DETECTED]
    return before.size > 0 and np.array_equal(before, now)


def _distances(uv: Array, detected: Array) -> Array:
    """(N,) from each point (N, 2) to the nearest detection (D, 2)."""
    return np.linalg.norm(uv[:, None] - detected[None], axis=2).min(1, initial=np.inf)
