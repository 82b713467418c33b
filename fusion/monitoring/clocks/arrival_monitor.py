# SPDX-License-Identifier: BSD-3-Clause
"""Finds the cameras whose stamps jumped relative to those of the other cameras, by the arrival of their frames.

The lag of a frame is its arrival minus its stamp: delays that all cameras share (the server's clock, its queue, the
network), and the camera's own clock. So a change that more than half of the cameras share is no evidence about any of
them; the cameras that do not share it changed relative to the others. A shared change is wrong for certain if frames
arrive before their stamps since. See docs/design/time_offsets.md section 4.
"""

import logging
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from fusion.monitoring.clocks.stamp_check import StampCheck

log = logging.getLogger("fusion")
ACTIVE_NS = 1_000_000_000  # since its last frame a camera counts
MAX_CLOCK_ERROR_NS = 4_000_000  # of a camera's clock: a frame may seem to arrive so much before it was taken


@dataclass(slots=True)
class _Arrivals:
    """One camera.

    Attributes:
        check: of its own lags.
        received_ns: of the last frame.
        has_changed: whether its stamps jumped, by its own lags, since the last settlement.
        earlier_ns: the sum of its jumps before the last one.
        has_paused: whether more than half of the cameras had an irregular interval with it.
    """

    check: StampCheck
    received_ns: int = 0
    has_changed: bool = False
    earlier_ns: float = 0.0
    has_paused: bool = False

    @property
    def change_ns(self) -> float:
        """By how much the stamps changed."""
        return self.earlier_ns + self.check.change_ns() if self.has_changed else 0.0


class ArrivalMonitor:
    """The changes of the stamps of all cameras relative to the arrival of their frames.

    Args:
        names: of the cameras.
    """

    def __init__(self, names: Iterable[str]) -> None:
        self._cameras = {name: _Arrivals(StampCheck()) for name in names}
        self._shared: set[str] = set()  # cameras of the change that more than half of the cameras share
        self.jumped: frozenset[str] = frozenset()
        self.undecided: frozenset[str] = frozenset()  # cameras that may have jumped, unlike most others
        self.impossible_ns = 0.0  # a change that all cameras shared with the last frame, into the future
        self._is_open = False  # whether a camera has changed or may have

    def observe(self, name: str, t_ns: int, received_ns: int) -> None:
        """Take the stamp and the arrival of the next frame of a camera; `jumped`, `undecided` and `impossible_ns`
        are valid after it."""
        camera = self._cameras[name]
        camera.received_ns, self.impossible_ns = received_ns, 0.0
        change_ns = camera.change_ns
        if camera.check.has_jumped(t_ns, received_ns):
            camera.earlier_ns, camera.has_changed = change_ns, True
        elif not (self._is_open or camera.check.is_undecided):
            return
        self._compare(received_ns)
        self._note_open()

    def jump_ns(self, name: str) -> float | None:
        """By how much the stamps of a camera jumped relative to the others; None if arrivals do not show it."""
        camera = self._cameras[name]
        is_known = all(other.check.is_timed for other in self._cameras.values() if other.has_changed)
        if name not in self.jumped or not is_known:
            return None
        return camera.change_ns - self._shared_ns()

    def least_jump_ns(self, name: str) -> float | None:
        """The smallest jump of a camera that agrees with arrivals; None if they show none."""
        jump_ns = self.jump_ns(name)
        return self._cameras[name].check.least_change_ns() if jump_ns is None else abs(jump_ns)

    def settle(self, name: str) -> None:
        """The stamps of a camera agree with those of the others now, corrected or not."""
        camera, shared_ns = self._cameras[name], self._shared_ns()
        camera.check.accept()
        self.undecided -= {name}
        camera.has_changed = bool(self._shared)
        camera.earlier_ns = shared_ns - camera.check.change_ns()
        self.jumped -= {name}
        if self._shared:
            self._shared.add(name)
        self._note_open()

    def reset(self, name: str) -> None:
        """Forget a camera."""
        self._cameras[name] = _Arrivals(StampCheck())
        self.jumped -= {name}
        self._shared -= {name}
        self.undecided -= {name}
        self._note_open()

    def _note_open(self) -> None:
        cameras = self._cameras.values()
        self._is_open = bool(self.undecided) or any(c.has_changed or c.check.is_undecided for c in cameras)

    def _shared_ns(self) -> float:
        changes = [self._cameras[name].change_ns for name in self._shared]
        return float(np.median(changes)) if changes else 0.0

    def _compare(self, now_ns: int) -> None:
        """Find the cameras that changed relative to the others."""
        active = {
            name
            for name, camera in self._cameras.items()
            if now_ns < camera.received_ns + ACTIVE_NS and (camera.has_changed or camera.check.is_learned)
        }
        changed = {name for name in self._cameras if self._cameras[name].has_changed}
        self._shared = max((self._alike(name, changed & active) for name in changed), key=len, default=set())
        if 2 * len(self._shared) <= len(active) or (self._shared < active and self._is_impossible()):
            self._shared = set()
        self.jumped = frozenset(active - self._shared if self._shared else changed)
        if self._shared and not self.jumped:
            self._settle_all()
        self.undecided = self._undecided_of(active)

    def _is_impossible(self) -> bool:
        """Whether the frames of the shared change arrive before their stamps: however many, their stamps are wrong."""
        checks = [self._cameras[name].check for name in self._shared]
        is_timed = all(check.is_timed for check in checks)
        return is_timed and bool(np.median([check.lag_ns for check in checks]) < -MAX_CLOCK_ERROR_NS)

    def _undecided_of(self, active: set[str]) -> frozenset[str]:
        """The active cameras that may have jumped; a pause that more than half of them share is none of theirs."""
        undecided = {name for name in active if self._cameras[name].check.is_undecided}
        is_shared = 2 * len(undecided) > len(active)
        for name, camera in self._cameras.items():
            camera.has_paused = name in undecided and (camera.has_paused or is_shared)
        return frozenset(name for name in undecided if not self._cameras[name].has_paused)

    def _alike(self, name: str, others: set[str]) -> set[str]:
        """The cameras whose stamps changed by as much as those of one of them."""
        camera = self._cameras[name]
        return {
            other
            for other in others
            if abs(self._cameras[other].change_ns - camera.change_ns)
            <= max(camera.check.tolerance_ns, self._cameras[other].check.tolerance_ns)
        }

    def _settle_all(self) -> None:
        """All cameras changed alike."""
        shared_ns, is_impossible = self._shared_ns(), self._is_impossible()
        is_timed = all(self._cameras[name].check.is_timed for name in self._shared)
        for camera in self._cameras.values():
            camera.has_changed, camera.earlier_ns = False, 0.0
        self._shared = set()
        if not is_timed:
            return
        if is_impossible:
            self.impossible_ns = shared_ns
        done = f"corrected by {-shared_ns * 1e-6:.0f} ms" if self.impossible_ns else "not corrected"
        log.warning("the stamps of all cameras jumped by %.0f ms together; %s", shared_ns * 1e-6, done)
