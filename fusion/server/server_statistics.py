# SPDX-License-Identifier: BSD-3-Clause
"""The server's statistics: counts and rates for the status of each second, and one log line per change."""

import logging
import os
import resource
import threading
import time
from collections import Counter, deque
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from camera_node.foundation.logs import about
from fusion.model.limits import Limits
from fusion.monitoring.camera_clocks import ClockHealth
from fusion.protocol.pose_messages import (
    SKIPPED_S,
    CameraHealth,
    Contradiction,
    FusionStatus,
    TrackingState,
)
from fusion.tracking.result import CameraUse

log = logging.getLogger("fusion")
ON_TIME_S = 30.0  # without a late frame, after which a camera is on time again: at most two lines a minute
LOGGED_LATE = 3  # late frames, each within `ON_TIME_S` of the last: a busy machine delays single ones
SILENT_S = 2.0  # without a frame: a camera is gone
PERIOD_NS = 1_000_000_000
LATE = "frames that arrived too late"


@dataclass(frozen=True)
class PipelineStatus:
    """The pipeline's part of the status.

    Attributes:
        limits: with which the server tracks.
        calibrated: cameras with a pose in the active rig.
        excluded: cameras that were moved, whose detections are excluded.
        frozen: cameras that repeat an old image.
        clocks: of the cameras, by name.
        measured_diameters_m: of the discs of robots that declare another diameter.
        not_acquired: why robots were not acquired, by name.
        contradictions: of residuals to their claims.
        unsaved_robots: names of the robots whose changes a restart would undo.
        rig_t_ns: since when the active rig is in force.
        robots_digest: of the robots in use.
    """

    limits: Limits | None = None
    calibrated: frozenset[str] = frozenset()
    excluded: frozenset[str] = frozenset()
    frozen: frozenset[str] = frozenset()
    clocks: dict[str, ClockHealth] = field(default_factory=dict)
    measured_diameters_m: dict[str, float] = field(default_factory=dict)
    not_acquired: dict[str, str] = field(default_factory=dict)
    contradictions: tuple[Contradiction, ...] = ()
    unsaved_robots: tuple[str, ...] = ()
    rig_t_ns: int | None = None
    robots_digest: str | None = None


@dataclass
class _CameraCounts:
    """One camera: its counts since the last status, and the states that were logged."""

    last_ns: int = 0
    is_gone: bool = False
    is_retired: bool = False  # renamed or forgotten: not listed, although its last frames may still arrive
    taken_ns: int = 0  # when its newest frame was taken
    late_since_ns: int = 0  # of the state in which its frames are too late; 0 while they are on time
    late_ns: int = 0  # when the last frame arrived too late
    late_before: int = 0  # frames that were too late before this state
    has_two_publishers: bool = False
    was_excluded: bool = False  # at some time since the last status
    lateness_ms: list[float] = field(default_factory=list)
    assigned: int = 0
    unassigned: int = 0
    squared_px: float = 0.0
    late: int = 0
    faults: Counter[str] = field(default_factory=Counter)
    reported: Counter[str] = field(default_factory=Counter)  # the faults at the last status
    growing: frozenset[str] = frozenset()  # faults that occurred in the second before it
    skipped: Counter[str] = field(default_factory=Counter)  # frames since the last status
    skipped_before: deque[Counter[str]] = field(default_factory=lambda: deque(maxlen=SKIPPED_S))


class ServerStatistics:
    """Counts what the server receives and computes.

    `count_fault` and `count_refusal` are callable from any thread, the rest from one.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._faults: Counter[str] = Counter()
        self._cameras: dict[str, _CameraCounts] = {}
        self._robots: dict[str, TrackingState] = {}
        self._latencies_ms: list[float] = []
        self._n_frame_sets = 0
        self._since_ns = 0
        self._cpu_s = time.process_time()
        self._calibrated: frozenset[str] = frozenset()

    def _about(self, name: str) -> dict[str, str]:
        """The subject of a line about a camera of the rig; other names may come from anybody."""
        return about(name) if name in self._calibrated else {}

    def count_fault(self, reason: str, camera: str | None = None) -> None:
        """Count something that was skipped, also among a camera's own faults if it is one of the known cameras."""
        with self._lock:
            self._faults[reason] += 1
            if camera is not None and camera in self._cameras:
                self._cameras[camera].faults[reason] += 1

    def count_refusal(self, reason: str, camera: str | None) -> None:
        """Count a frame that is not used: a fault, and among what the camera's health has of the last seconds."""
        self.count_fault(reason, camera)
        with self._lock:
            if camera is not None and camera in self._cameras:
                self._cameras[camera].skipped[reason] += 1

    def count_arrival(self, name: str, t_ns: int, received_ns: int) -> None:
        """Count a camera's frame; log a camera that is new or back."""
        if name not in self._cameras:
            log.info("camera %s appeared", name, extra=self._about(name))
            self._cameras[name] = _CameraCounts()
        camera = self._cameras[name]
        if camera.is_gone and not camera.is_retired:
            log.info("camera %s is back", name, extra=self._about(name))
        # Only another camera with this name has a gap in the times of its frames, however late they arrive.
        camera.is_retired &= t_ns - camera.taken_ns <= SILENT_S * 1e9
        camera.is_gone, camera.last_ns, camera.taken_ns = False, received_ns, t_ns
        camera.lateness_ms.append((received_ns - t_ns) * 1e-6)

    def sends_frames(self, name: str) -> bool:
        """Whether the camera sent a frame since the server started, and was not retired since then."""
        return name in self._cameras and not self._cameras[name].is_retired

    def retire(self, name: str, is_retired: bool = True) -> None:
        """List a camera no more, which has another name or was forgotten; or again, because a camera has this name."""
        if name in self._cameras:
            self._cameras[name].is_retired = is_retired

    def note_moved(self, name: str) -> None:
        """Log that a camera was moved and is excluded; the next status shows it, however soon it is used again."""
        moved = "camera %s was moved: excluded until robots show its new pose"
        log.warning(moved, name, extra=self._about(name))
        if name in self._cameras:
            self._cameras[name].was_excluded = True

    def note_publishers(self, name: str, has_two_publishers: bool) -> None:
        """Log once that two nodes publish under a camera's name."""
        camera = self._cameras[name]
        if has_two_publishers and not camera.has_two_publishers:
            log.warning(
                "two nodes publish as camera %s: give each a --name of its own", name, extra=self._about(name)
            )
        camera.has_two_publishers = has_two_publishers

    def note_late(self, name: str, age_ms: float, limit_ms: float) -> None:
        """Count a camera's frame that came too late; log number `LOGGED_LATE`, until none did for `ON_TIME_S`.

        Args:
            name: of the camera.
            age_ms: of the frame when it arrived.
            limit_ms: up to which a frame set would have waited for it; a younger frame came after later ones.
        """
        camera = self._cameras[name]
        if not camera.late_since_ns:
            camera.late_since_ns, camera.late_before = camera.last_ns, camera.late
        camera.late, camera.late_ns = camera.late + 1, camera.last_ns
        if camera.late - camera.late_before == LOGGED_LATE:
            if age_ms > limit_ms:
                late = "%s is %.0f ms late (limit %.0f ms); its late frames are dropped"
                log.warning(late, name, age_ms, limit_ms, extra=self._about(name))
            else:
                late = "%s: a frame came after later ones, %.0f ms old; such frames are dropped"
                log.warning(late, name, age_ms, extra=self._about(name))
        with self._lock:
            camera.skipped[LATE] += 1

    def note_on_time(self, name: str) -> None:
        """Log a camera of which no frame was too late for `ON_TIME_S`, with the number of those that were.

        On a busy machine some frames are late and others are not: that is one state.
        """
        camera = self._cameras[name]
        if camera.late_since_ns and camera.last_ns - camera.late_ns > ON_TIME_S * 1e9:
            seconds, count = (camera.late_ns - camera.late_since_ns) * 1e-9, camera.late - camera.late_before
            if count >= LOGGED_LATE:
                text = "%s is on time again: %d of its frames in %.0f s were too late and were dropped"
                log.info(text, name, count, seconds, extra=self._about(name))
            camera.late_since_ns = 0

    def count_frame_set(
        self, cameras: dict[str, CameraUse], robots: dict[str, TrackingState], latency_ms: float | None
    ) -> None:
        """Count a fused frame set: the use of each camera's detections, each robot's state, and the latency."""
        self._n_frame_sets += 1
        self._robots = robots
        if latency_ms is not None:
            self._latencies_ms.append(latency_ms)
        for name, use in cameras.items():
            if camera := self._cameras.get(name):
                camera.assigned += use.used
                camera.unassigned += use.unused
                camera.squared_px += use.squared_px

    def is_due(self, now_ns: int) -> bool:
        """Whether a second has passed since the last status, or the clock was set back."""
        return not 0 <= now_ns - self._since_ns < PERIOD_NS

    def report(self, now_ns: int, pipeline: PipelineStatus) -> FusionStatus:
        """The status since the last one; resets the counts of that period."""
        seconds = (now_ns - self._since_ns) * 1e-9 if 0 < self._since_ns < now_ns else 1.0
        self._calibrated = pipeline.calibrated
        self._find_silent_cameras(now_ns)
        self._find_faulty_cameras()
        self._remember_skipped()
        cpu_s = time.process_time()
        with self._lock:
            faults = dict(self._faults)
        status = FusionStatus(
            t_ns=now_ns,
            frame_sets_per_s=self._n_frame_sets / seconds,
            latency_ms=float(np.median(self._latencies_ms)) if self._latencies_ms else None,
            cpu=(cpu_s - self._cpu_s) / seconds,
            memory_mb=memory_mb(),
            cameras={
                name: _camera_health(name, camera, seconds, pipeline)
                for name, camera in self._cameras.items()
                if not camera.is_retired
            },
            robots=dict(self._robots),
            faults=faults,
            limits=pipeline.limits,
            measured_diameters_m=pipeline.measured_diameters_m,
            not_acquired=pipeline.not_acquired,
            contradictions=pipeline.contradictions,
            unsaved_robots=pipeline.unsaved_robots,
            rig_t_ns=pipeline.rig_t_ns,
            robots_digest=pipeline.robots_digest,
        )
        self._since_ns, self._cpu_s = now_ns, cpu_s
        self._reset()
        return status

    def _reset(self) -> None:
        self._n_frame_sets = 0
        self._latencies_ms.clear()
        for camera in self._cameras.values():
            camera.lateness_ms.clear()
            camera.assigned = camera.unassigned = 0
            camera.squared_px = 0.0
            camera.was_excluded = False

    def _find_silent_cameras(self, now_ns: int) -> None:
        silent = {n: c for n, c in self._cameras.items() if now_ns - c.last_ns > SILENT_S * 1e9}
        for name, camera in silent.items():
            if not (camera.is_gone or camera.is_retired):
                log.warning("camera %s is gone: no frame for %.0f s", name, SILENT_S, extra=self._about(name))
            camera.is_gone = True

    def _remember_skipped(self) -> None:
        for camera in self._cameras.values():
            with self._lock:
                camera.skipped_before.append(camera.skipped)
                camera.skipped = Counter()

    def _find_faulty_cameras(self) -> None:
        """Log the faults of a camera once when they begin."""
        for name, camera in self._cameras.items():
            with self._lock:
                new = camera.faults - camera.reported
                camera.reported = camera.faults.copy()
            for reason in sorted(new.keys() - camera.growing):
                fault = "camera %s: %s, %d in the last second"
                log.warning(fault, name, reason, new[reason], extra=self._about(name))
            camera.growing = frozenset(new)


def memory_mb() -> float:
    """Resident memory of this process; its peak where the system does not report the present one."""
    statm = Path("/proc/self/statm")
    if statm.exists():
        return int(statm.read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6  # macOS counts bytes


def _camera_health(
    name: str, camera: _CameraCounts, seconds: float, pipeline: PipelineStatus
) -> CameraHealth:
    clock = pipeline.clocks.get(name, ClockHealth())
    return CameraHealth(
        fps=len(camera.lateness_ms) / seconds,
        lateness_ms=float(np.mean(camera.lateness_ms)) if camera.lateness_ms else 0.0,
        residual_px=float(np.sqrt(camera.squared_px / camera.assigned)) if camera.assigned else None,
        assigned=camera.assigned,
        unassigned=camera.unassigned,
        late=camera.late,
        calibrated=name in pipeline.calibrated,
        excluded=camera.was_excluded or name in pipeline.excluded,
        frozen=name in pipeline.frozen,
        duplicate_publisher=camera.has_two_publishers,
        faults=dict(camera.faults),
        skipped=dict(sum(camera.skipped_before, Counter())),
        clock=clock.state,
        clock_correction_ms=clock.offset_ms,
        clock_sigma_ms=clock.sigma_ms,
    )
