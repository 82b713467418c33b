# SPDX-License-Identifier: BSD-3-Clause
"""How the server does: counts, rates and one log line per change, told once a second."""

import logging
import os
import resource
import threading
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from fusion.protocol.messages import CameraHealth, FusionStatus, TrackingState
from fusion.tracking.result import CameraUse

log = logging.getLogger("fusion")
MAX_STRANGERS = 64  # cameras that the rig does not know: more names are a fault of whoever publishes them
GONE_S = 2.0
PERIOD_NS = 1_000_000_000


@dataclass
class _Camera:
    """One camera: since the last status, and what was said of it last."""

    last_ns: int = 0
    gone: bool = False
    late: bool = False
    shared: bool = False
    lateness_ms: list[float] = field(default_factory=list)
    used: int = 0
    unused: int = 0
    squared_px: float = 0.0


class ServerStatistics:
    """Counts what the server sees; `count` may be called from any thread, the rest from the server's."""

    def __init__(self, limit_ms: float) -> None:
        """`limit_ms`: how long an instant waits, for the messages."""
        self.limit_ms = limit_ms
        self._lock = threading.Lock()
        self._faults: Counter[str] = Counter()
        self._cameras: dict[str, _Camera] = {}
        self._known: set[str] = set()  # those that the rig placed
        self._robots: dict[str, TrackingState] = {}
        self._latencies: list[float] = []
        self._instants = 0
        self._since_ns = 0
        self._cpu_s = time.process_time()

    def count(self, fault: str) -> None:
        """Count something that was skipped."""
        with self._lock:
            self._faults[fault] += 1

    def arrived(self, name: str, t_ns: int, received_ns: int, known: bool) -> bool:
        """Note a camera's frame; False of one that the rig does not know, if there are too many of these."""
        if name not in self._cameras:
            if not known and len(self._cameras.keys() - self._known) >= MAX_STRANGERS:
                self.count("too many cameras")
                return False
            log.info("camera %s appeared", name)
        if known:
            self._known.add(name)
        camera = self._cameras.setdefault(name, _Camera())
        if camera.gone:
            log.info("camera %s is back", name)
        camera.gone, camera.last_ns = False, received_ns
        camera.lateness_ms.append((received_ns - t_ns) * 1e-6)
        return True

    def shared(self, name: str, is_shared: bool) -> None:
        """Say once when two nodes publish under a camera's name, and when one of them ended."""
        camera = self._cameras[name]
        if is_shared and not camera.shared:
            log.warning("two nodes publish as camera %s: give each a --name of its own", name)
        camera.shared = is_shared

    def noted(self, name: str, in_time: bool, late_ms: float) -> None:
        """Say once when a camera's frames begin to come too late, and when they come in time again."""
        camera = self._cameras[name]
        if not in_time and not camera.late:
            log.warning(
                "%s is %.0f ms late (limit %.0f ms); its frames are dropped", name, late_ms, self.limit_ms
            )
            camera.late = True
        elif in_time and camera.late and late_ms < self.limit_ms:
            log.info("%s is in time again", name)
            camera.late = False

    def fused(
        self, cameras: dict[str, CameraUse], robots: dict[str, TrackingState], latency_ms: float | None
    ) -> None:
        """Note an instant."""
        self._instants += 1
        self._robots = robots
        if latency_ms is not None:
            self._latencies.append(latency_ms)
        for name, use in cameras.items():
            if camera := self._cameras.get(name):
                camera.used += use.used
                camera.unused += use.unused
                camera.squared_px += use.squared_px

    def status(
        self,
        now_ns: int,
        calibrated: set[str],
        late: dict[str, int],
        aside: set[str],
        misfits: Callable[[], dict[str, float]] = dict,
    ) -> FusionStatus | None:
        """The status of the last second, or None before it is over."""
        if 0 <= now_ns - self._since_ns < PERIOD_NS:
            return None
        seconds = (now_ns - self._since_ns) * 1e-9 if 0 < self._since_ns < now_ns else 1.0
        self._find_gone(now_ns)
        cameras = {
            name: _told(c, seconds, late.get(name, 0), name in calibrated, name in aside)
            for name, c in self._cameras.items()
        }
        cpu_s = time.process_time()
        with self._lock:
            faults = dict(self._faults)
        status = FusionStatus(
            t_ns=now_ns,
            instants_per_s=self._instants / seconds,
            latency_ms=float(np.median(self._latencies)) if self._latencies else None,
            cpu=(cpu_s - self._cpu_s) / seconds,
            memory_mb=memory_mb(),
            cameras=cameras,
            robots=dict(self._robots),
            faults=faults,
            misfits=misfits(),
        )
        self._since_ns, self._cpu_s, self._instants = now_ns, cpu_s, 0
        self._latencies.clear()
        return status

    def _find_gone(self, now_ns: int) -> None:
        for name, camera in self._cameras.items():
            if not camera.gone and now_ns - camera.last_ns > GONE_S * 1e9:
                log.warning("camera %s is gone: no frame for %.0f s", name, GONE_S)
                camera.gone = True


def memory_mb() -> float:
    """Resident memory of this process; its peak where the system does not tell the present one."""
    statm = Path("/proc/self/statm")
    if statm.exists():
        return int(statm.read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6  # macOS counts bytes


def _told(camera: _Camera, seconds: float, late: int, calibrated: bool, aside: bool) -> CameraHealth:
    """What the last second says of a camera, which is then forgotten."""
    told = CameraHealth(
        fps=len(camera.lateness_ms) / seconds,
        lateness_ms=float(np.mean(camera.lateness_ms)) if camera.lateness_ms else 0.0,
        residual_px=float(np.sqrt(camera.squared_px / camera.used)) if camera.used else None,
        used=camera.used,
        unused=camera.unused,
        late=late,
        calibrated=calibrated,
        aside=aside,
        shared=camera.shared,
    )
    camera.lateness_ms.clear()
    camera.used = camera.unused = 0
    camera.squared_px = 0.0
    return told
