# SPDX-License-Identifier: BSD-3-Clause
"""By what an arena reports faults: lines of its programs' logs, and statuses of the server and of the cameras."""

from collections.abc import Callable
from dataclasses import dataclass, field

from fusion.model.limits import Limits
from fusion.protocol.pose_messages import CameraHealth
from tests.benchmarks.faults.arena import LiveArena

LATENESS_MS = Limits().lateness_ms  # for which the server waits for a frame


@dataclass
class Evidence:
    """What the arena reported since a fault began: log lines as "program: line", and counters before it."""

    arena: LiveArena
    lines: list[str] = field(default_factory=list)
    counted: dict[str, int] = field(default_factory=dict)
    begun_ns: int = 0

    def logged(self, *words: str) -> str:
        """A line with all of these words; empty without one."""
        return next((line for line in self.lines if all(word in line for word in words)), "")

    def health(self, camera: str):
        """The server's figures of a camera, if they are newer than the fault."""
        status = self.arena.status
        return status.cameras.get(camera) if status and status.t_ns > self.begun_ns else None

    def node(self, camera: str):
        """A camera's own status, if it is newer than the fault."""
        status = self.arena.camera_status.get(camera)
        return status if status and status.t_ns > self.begun_ns else None

    def robot(self, name: str) -> str:
        """The state of a robot in the server's status."""
        status = self.arena.status
        return status.robots.get(name, "") if status and status.t_ns > self.begun_ns else ""

    def count(self, reason: str) -> int:
        """How much a counter of the server's rose."""
        faults = self.arena.status.faults if self.arena.status else {}
        return faults.get(reason, 0) - self.counted.get(reason, 0)


def gone(camera: str) -> Callable[[Evidence], str]:
    """The server's log says that a camera is gone, or its status that no frames arrive."""

    def report(seen: Evidence) -> str:
        health = seen.health(camera)
        silent = "status: 0 frames/s" if health and health.fps == 0 else ""
        return seen.logged("server:", camera, "gone") or silent

    return report


def advised(camera: str, word: str) -> Callable[[Evidence], str]:
    """The camera's status advises on its exposure."""

    def report(seen: Evidence) -> str:
        status = seen.node(camera)
        return status.advice if status and word in status.advice else ""

    return report


def suspected(camera: str) -> Callable[[Evidence], str]:
    """The server names the camera in its log, or its status says what is wrong with it."""

    def report(seen: Evidence) -> str:
        health = seen.health(camera)
        line = seen.logged("server:", camera)
        return line or (_suspicion(health) if health else "")

    return report


def _suspicion(health: CameraHealth) -> str:
    """Why the server does not use a camera as it is; empty if it does."""
    if health.excluded:
        return "status: excluded"
    if health.frozen:
        return "status: frozen"
    return "" if health.clock == "correct" else f"status: clock {health.clock}"


def late(camera: str) -> Callable[[Evidence], str]:
    """The server's log or its status says that frames arrive later than it waits for.

    Other faults make frames late, too, and the log has few lines of one kind: then only the status shows it.
    """

    def report(seen: Evidence) -> str:
        health = seen.health(camera)
        lateness_ms = health.lateness_ms if health else 0.0
        return seen.logged(camera, "late") or (
            f"status: lateness {lateness_ms:.0f} ms" if lateness_ms > LATENESS_MS else ""
        )

    return report
