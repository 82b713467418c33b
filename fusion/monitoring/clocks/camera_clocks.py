# SPDX-License-Identifier: BSD-3-Clause
"""Monitors the clocks of the cameras: excludes a camera whose stamps jumped, finds by how much, and corrects them.

    arrival of a frame   -> `ArrivalMonitor`: its stamp jumped, or may?  -> excluded from this frame on
    the rig graph        -> a clock alone explains the robots        -> corrected
    an excluded camera   -> `find_time_shift`: by how much?             -> corrected and used again
    slow information     -> `ClockComparison.drifts`                    -> corrected while in use

See docs/design/time_offsets.md.
"""

import logging
import math
import time
from collections import deque
from dataclasses import dataclass, field, replace
from typing import Literal

from camera_node.foundation.arrays import Mask
from camera_node.foundation.logs import about
from fusion.model.frames import CalibratedFrame
from fusion.model.observations import Assignments, CameraArray, DetectionTable, MarkerTable
from fusion.model.states import Snapshot
from fusion.monitoring.clocks.arrival_monitor import ArrivalMonitor
from fusion.monitoring.clocks.clock_comparison import ClockComparison
from fusion.monitoring.clocks.clock_drift import Drift
from fusion.monitoring.clocks.time_search import TimeShift, find_time_shift

log = logging.getLogger("fusion")
ClockState = Literal["correct", "excluded", "corrected"]

MAX_DRIFT_S = 0.01  # largest change of a correction by a slow departure
FOLLOWED_NS = 10_000_000_000  # after a departure, in which smaller ones of the same camera count
REPORTED_NS = 500_000  # smallest correction that is reported; later ones when it has doubled
MAX_KEPT = 200  # frames of an excluded camera
SEARCH_NS = 100_000_000  # between searches
MIN_EXPECTED = 16  # moving markers, for a decision
GIVE_UP_NS = 1_500_000_000  # without an explanation by time: above `RANGE_S`, so that the history covers it
# After which the arrival decides if no camera is left to compare with: above `GIVE_UP_NS`.
ALONE_NS = 2_000_000_000
STATIC_NS = 500_000_000  # without sufficient motion of robots, after which the arrival decides
ARRIVAL_SIGMA_S = 0.005  # of an offset that only the arrival shows
PAUSE_NS = 5_000_000_000  # after a false alarm, without another from the same evidence
MAX_AHEAD_NS = 200_000_000  # of a frame in corrected time, relative to its arrival


@dataclass(frozen=True, slots=True)
class ClockHealth:
    """A camera's clock: state, correction of its stamps in ms, and the standard deviation of the correction."""

    state: ClockState = "correct"
    offset_ms: float = 0.0
    sigma_ms: float = 0.0


@dataclass(slots=True)
class _Clock:
    """One camera.

    Attributes:
        correction_ns, sigma_s: added to its stamps, and the standard deviation.
        departed_ns: when it was last found to depart slowly.
        frames: the last ones of an excluded camera, with the present correction.
        since_ns: server time of the exclusion; 0 while the camera is in use.
        by_arrival: whether the arrival of its frames excluded it.
        searched_ns, trusted_ns: times of the last search, and until which no evidence of the same kind counts.
        reported_ns: the correction that was last reported.
    """

    state: ClockState = "correct"
    correction_ns: int = 0
    sigma_s: float = 0.0
    departed_ns: int = 0
    frames: deque[CalibratedFrame] = field(default_factory=lambda: deque(maxlen=MAX_KEPT))
    since_ns: int = 0
    by_arrival: bool = False
    searched_ns: int = 0
    trusted_ns: int = 0
    reported_ns: int = 0


class CameraClocks:
    """The clocks of all cameras of a rig.

    Frames pass `admit` before they form frame sets, and `observe` takes each frame set after the update.

    Args:
        cameras: cameras of the rig.
        markers: of all robots.
        single: as in `Estimator`.
    """

    def __init__(self, cameras: CameraArray, markers: MarkerTable, single: Mask) -> None:
        self._cameras, self._markers = cameras, markers
        self._clocks = {name: _Clock() for name in cameras.names}
        self._arrivals = ArrivalMonitor(cameras.names)
        self._comparison = ClockComparison(cameras, markers, single)
        self._now_ns = 0
        self._has_jumped = True  # by arrivals, a camera at the last frame

    @property
    def excluded(self) -> set[str]:
        """Names of the cameras whose frames are held back until their clocks are known."""
        return {name for name, clock in self._clocks.items() if clock.state == "excluded"}

    def health(self) -> dict[str, ClockHealth]:
        """By camera."""
        return {
            name: ClockHealth(clock.state, clock.correction_ns * 1e-6, clock.sigma_s * 1e3)
            for name, clock in self._clocks.items()
        }

    def inherit(self, old: "CameraClocks") -> None:
        """Continue with the clocks of the same cameras; the history of other robots is dropped."""
        self._clocks, self._arrivals = old._clocks, old._arrivals

    def admit(self, frame: CalibratedFrame) -> CalibratedFrame | None:
        """The frame in corrected time; None while its camera is excluded, or if that time is in the future."""
        clock = self._clocks[frame.camera]
        self._arrivals.observe(frame.camera, frame.t_ns, frame.received_ns)
        self._correct_all(self._arrivals.impossible_ns)
        self._exclude_jumped(frame.received_ns)
        if clock.correction_ns or clock.sigma_s:
            sigma_s = math.hypot(frame.clock_sigma_s, clock.sigma_s)
            frame = replace(frame, t_ns=frame.t_ns + clock.correction_ns, clock_sigma_s=sigma_s)
        if clock.state == "excluded":
            clock.frames.append(frame)
            if frame.received_ns > clock.since_ns + ALONE_NS:
                self._search(frame.camera, frame.received_ns)
            return None
        if frame.t_ns > frame.received_ns + MAX_AHEAD_NS:
            return None
        return frame

    def observe(
        self,
        now: Snapshot,
        detections: DetectionTable,
        assignments: Assignments,
        is_doubtful: bool = False,
    ) -> None:
        """Compare the cameras in a frame set.

        Args:
            now: the robots after the update.
            detections: of the frame set.
            assignments: of the detections.
            is_doubtful: a camera contradicts the others, so that states may be wrong: nothing is compared.
        """
        self._now_ns = now.t_ns
        self._comparison.observe(now)
        if is_doubtful:
            self._comparison.forget_latest()
        else:
            self._comparison.add(detections, assignments)
            departing = {k for k, clock in enumerate(self._clocks.values()) if self._departs(clock)}
            for drift in self._comparison.drifts(departing):
                self._correct_drift(drift)
        for name in self.excluded:
            self._search(name, self._now_ns)

    def reset(self, name: str) -> None:
        """Forget the clock of a camera that has another calibration."""
        self._clocks[name] = _Clock()
        self._arrivals.reset(name)
        self._comparison.forget()

    def _exclude_jumped(self, now_ns: int) -> None:
        """Exclude the cameras whose stamps jumped relative to the others, or may have, and use those whose did not."""
        jumped = self._arrivals.jumped | self._arrivals.undecided
        if not (jumped or self._has_jumped):
            return
        self._has_jumped = bool(jumped)  # the next frame readmits the last ones
        for name, clock in self._clocks.items():
            if clock.state == "excluded":
                if clock.by_arrival and name not in jumped:
                    clock.state, clock.by_arrival = _state_in_use(clock), False
            elif name in jumped and now_ns <= clock.trusted_ns:
                self._arrivals.settle(name)
            elif name in jumped:
                self._exclude(clock, now_ns)
                clock.by_arrival = True

    def _departs(self, clock: _Clock) -> bool:
        """Whether a clock departed slowly from the others just now."""
        return bool(clock.departed_ns) and self._now_ns < clock.departed_ns + FOLLOWED_NS

    def _exclude(self, clock: _Clock, now_ns: int) -> None:
        """Hold back the frames of a camera from now on."""
        clock.state, clock.since_ns, clock.by_arrival = "excluded", now_ns, False
        self._comparison.forget_since(now_ns)
        clock.frames.clear()
        clock.searched_ns = now_ns

    def _shift(self, name: str, clock: _Clock) -> TimeShift | None:
        return find_time_shift(
            self._cameras, name, tuple(clock.frames), tuple(self._comparison.history), self._markers
        )

    def _search(self, name: str, now_ns: int) -> None:
        """Find the time of an excluded camera's frames, and use it again if this is known."""
        clock = self._clocks[name]
        if now_ns < clock.searched_ns + SEARCH_NS:
            return
        clock.searched_ns = now_ns
        shift, waited_ns = self._shift(name, clock), now_ns - clock.since_ns
        jump_ns, least_ns = self._arrivals.jump_ns(name), self._arrivals.least_jump_ns(name)
        if (
            shift is not None
            and shift.explains(MIN_EXPECTED)
            and (least_ns is None or shift.resolves(least_ns * 1e-9))
        ):
            if shift.is_zero:
                self._readmit(name, now_ns)
            elif shift.is_told_apart:
                self._correct_jump(name, shift.offset_s, shift.sigma_s, clock.since_ns)
        elif jump_ns is not None and waited_ns > STATIC_NS:
            self._correct_jump(name, -jump_ns * 1e-9, ARRIVAL_SIGMA_S, clock.since_ns)
        elif waited_ns > GIVE_UP_NS:
            self._readmit(name, now_ns)

    def _readmit(self, name: str, now_ns: int) -> None:
        """Use a camera again whose clock is not at fault."""
        clock = self._clocks[name]
        clock.state, clock.trusted_ns = _state_in_use(clock), now_ns + PAUSE_NS
        self._arrivals.settle(name)
        self._comparison.forget_since(clock.since_ns)

    def _correct_all(self, jump_ns: float) -> None:
        """Correct a jump of all stamps, which changes no offset between cameras."""
        if jump_ns:
            for clock in self._clocks.values():
                clock.correction_ns -= round(jump_ns)
                clock.reported_ns -= round(jump_ns)
                clock.state = "excluded" if clock.state == "excluded" else "corrected"
                clock.frames.clear()

    def correct(self, name: str, offset_s: float, sigma_s: float) -> None:
        """Correct a camera whose clock the rig graph found to be off, unless its frames are searched for it already."""
        if self._clocks[name].state != "excluded":
            self._correct_jump(name, offset_s, sigma_s, self._now_ns)

    def _correct_jump(self, name: str, offset_s: float, sigma_s: float, since_ns: int) -> None:
        """Correct stamps that jumped at `since_ns`, server time."""
        clock = self._clocks[name]
        clock.correction_ns += round(offset_s * 1e9)
        clock.state, clock.sigma_s, clock.reported_ns = "corrected", sigma_s, clock.correction_ns
        self._arrivals.settle(name)
        self._comparison.forget_since(since_ns)
        clock.frames.clear()
        at = time.strftime("%H:%M:%S", time.localtime(since_ns * 1e-9))
        message = "camera %s: stamps jumped by %.0f ms at %s; corrected by %.1f ms"
        log.warning(message, name, -1e3 * offset_s, at, 1e3 * offset_s, extra=about(name))

    def _correct_drift(self, drift: Drift) -> None:
        """Correct a camera that is in use."""
        name = self._cameras.names[drift.camera]
        clock, change_s = self._clocks[name], drift.at(self._now_ns)
        if clock.state == "excluded":
            return
        if abs(change_s) > MAX_DRIFT_S:
            self._exclude(clock, self._now_ns)
            return
        clock.correction_ns += round(change_s * 1e9)
        clock.state, clock.sigma_s, clock.departed_ns = "corrected", drift.sigma_s, self._now_ns
        self._comparison.correct(drift)
        if abs(clock.correction_ns - clock.reported_ns) < REPORTED_NS + abs(clock.reported_ns):
            return
        clock.reported_ns = clock.correction_ns
        rate = f" by {-1e6 * drift.rate:.0f} ppm" if drift.rate else ""
        message = "camera %s: its clock drifts from the others%s; its stamps are corrected, now by %.1f ms"
        log.warning(message, name, rate, clock.correction_ns * 1e-6, extra=about(name))

    def rebase(self) -> None:
        """A camera has another pose: its calibration errors, which bias offsets, are others."""
        self._comparison.forget()


def _state_in_use(clock: _Clock) -> ClockState:
    return "corrected" if clock.correction_ns else "correct"
