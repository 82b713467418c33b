# SPDX-License-Identifier: BSD-3-Clause
"""Corrects the stamps of cameras whose clocks jump or drift, and states how well they are known.

    the next frame of a camera  -> `StampCheck`: stamps jumped      -> corrected from this frame on
                                                 they may have      -> their standard deviation grows by the jump
    the rig graph's keyframes   -> offsets between the cameras      -> corrected where significant

A camera is always used, with the standard deviation of its clock as noise along the motion of its detections.
See docs/design/time_offsets.md.
"""

import logging
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from statistics import median_high, median_low
from typing import Literal

from camera_node.foundation.logs import about
from fusion.model.frames import MAX_CLOCK_ERROR_S, CalibratedFrame, FrameSet
from fusion.monitoring.stamp_check import StampCheck
from fusion.rig_graph.clock_walk import Departure

log = logging.getLogger("fusion")
ClockState = Literal["correct", "uncertain", "corrected"]
REPORTED_S = 0.0005  # smallest correction that is reported; later ones when it has doubled
MAX_MOTION_M = 0.005  # of a robot in the standard deviation of a camera's clock, so that it locates the robot
REGULAR_S = 0.0005  # standard deviation of the stamps of good drivers, as of calibrated clocks; from twice it reported
CERTAIN = 3.0  # standard deviations by which a correction may be wrong before a lag contradicts it: 1 in 700
DECAY_S = 10.0  # of an offset that most corrections have in common: a fault of a clock adds 0.2 ms to it
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
        check: of its stamps.
        correction_s, sigma_s: added to its stamps at `since_ns`, and the standard deviation.
        rate, rate_sigma: by which that grows, and the standard deviation.
        doubt_s: an offset that robots may show.
        stepped_s: the part of the correction that the steps of its stamps show.
        since_ns, now_ns: the time of the last estimate, and of the last frame.
        reported_s: the correction that was last reported.
        irregular_s: the standard deviation of single stamps that was last reported.
    """

    check: StampCheck
    correction_s: float = 0.0
    sigma_s: float = 0.0
    rate: float = 0.0
    rate_sigma: float = 0.0
    doubt_s: float = 0.0
    stepped_s: float = 0.0
    since_ns: int = 0
    now_ns: int = 0
    reported_s: float = 0.0
    irregular_s: float = REGULAR_S

    def at(self, t_ns: int) -> float:
        """The correction at a time, s."""
        return self.correction_s + self.rate * (t_ns - self.since_ns) * 1e-9

    def unexplained_s(self, t_ns: int) -> float:
        """The correction at a time, or what it is more than the steps of its stamps show: the smaller one."""
        correction_s = self.at(t_ns)
        return min(correction_s, correction_s - self.stepped_s, key=abs)

    @property
    def known_s(self) -> float:
        """Standard deviation of the correction of the last frame: the rate is not known exactly."""
        grown_s = self.rate_sigma * (self.now_ns - self.since_ns) * 1e-9
        return math.hypot(self.sigma_s, grown_s, self.doubt_s)

    def report_irregular(self, name: str, sigma_s: float) -> None:
        """Log that stamps are irregular, and again once they are twice as much."""
        if sigma_s > 2 * self.irregular_s:
            self.irregular_s = sigma_s
            log.warning(
                "camera %s: its frames have irregular stamps, by %.1f ms, which poses of moving robots claim; let its "
                "driver state when frames were exposed",
                *(name, 1e3 * sigma_s),
                extra=about(name),
            )

    @property
    def is_off(self) -> bool:
        """Whether the correction is more than its own uncertainty. A clock from which others departed has none of its
        own: it takes a part of their rates (`hold_common`)."""
        return abs(self.at(self.now_ns)) > CERTAIN * self.known_s > 0

    @property
    def health(self) -> ClockHealth:
        offset_s, sigma_s = self.at(self.now_ns), self.known_s
        size_s = max(REPORTED_S, abs(offset_s))
        # However large a correction, such a clock does not locate a robot of 1 m/s.
        is_uncertain = sigma_s > size_s or 1.0 * sigma_s > MAX_MOTION_M
        state = "uncertain" if is_uncertain else "corrected" if size_s > REPORTED_S else "correct"
        return ClockHealth(state, 1e3 * offset_s, 1e3 * sigma_s)


class CameraClocks:
    """The clocks of all cameras of a rig.

    Args:
        names: of the cameras.
    """

    def __init__(self, names: tuple[str, ...]) -> None:
        self._names, self._clocks = names, {name: _Clock(StampCheck()) for name in names}
        self._held_ns = 0  # when no offset was held to be common

    def health(self) -> dict[str, ClockHealth]:
        """By camera."""
        return {name: clock.health for name, clock in self._clocks.items()}

    def inherit(self, old: "CameraClocks") -> None:
        """Continue with the clocks of the same cameras."""
        self._clocks = old._clocks

    def reset(self, name: str) -> None:
        """Forget the clock of a camera that has another calibration."""
        self._clocks[name] = _Clock(StampCheck())

    def observe(self, frame: CalibratedFrame) -> tuple[float, float]:
        """Take the stamp and the arrival of the next frame of a camera; the standard deviations of its clock, s, and of
        its rate, if its stamps jumped, or may have, else 0."""
        name, clock = frame.camera, self._clocks[frame.camera]
        clock.now_ns = frame.t_ns
        least_lag_s = clock.at(frame.t_ns) - CERTAIN * clock.known_s
        jump = clock.check.add(frame.t_ns, frame.received_ns, 1e9 * least_lag_s)
        if jump is None:
            return self._refute(frame)
        # The clock was set, or is another one: its rate may have ended.
        sigma_s, rate_sigma = 1e-9 * jump.sigma_ns, math.hypot(clock.rate, clock.rate_sigma)
        clock.sigma_s, clock.rate_sigma = math.hypot(clock.known_s, sigma_s), rate_sigma
        clock.correction_s, clock.since_ns = clock.at(frame.t_ns) - 1e-9 * jump.ahead_ns, frame.t_ns
        clock.stepped_s -= 1e-9 * jump.ahead_ns
        if not jump.ahead_ns:
            return sigma_s, rate_sigma
        clock.reported_s, clock.rate = clock.correction_s, 0.0
        message = "camera %s: its stamps jumped by %.0f ms; they are corrected, now by %.1f ms"
        log.warning(message, name, 1e-6 * jump.ahead_ns, 1e3 * clock.at(frame.t_ns), extra=about(name))
        return sigma_s, rate_sigma

    def _refute(self, frame: CalibratedFrame) -> tuple[float, float]:
        """Forget a correction by which a frame would arrive long before it was sent: the stamps jumped back, unnoticed
        so soon after the jump before. The standard deviation of the clock is the correction."""
        wrong = self._clocks[frame.camera]
        wrong_s = wrong.at(frame.t_ns)
        if frame.t_ns + 1e9 * wrong_s <= frame.received_ns + MAX_AHEAD_NS or not wrong_s:
            return 0.0, 0.0
        self.reset(frame.camera)
        clock = self._clocks[frame.camera]
        clock.now_ns, clock.sigma_s = frame.t_ns, abs(wrong_s)
        log.warning(
            "camera %s: its stamps jumped back; they are no longer corrected by %.1f ms",
            *(frame.camera, 1e3 * wrong_s),
            extra=about(frame.camera),
        )
        return abs(wrong_s), abs(wrong.rate)

    def admit(self, frame: CalibratedFrame) -> CalibratedFrame | None:
        """A frame in corrected time; None if that time is in the future."""
        name, clock = frame.camera, self._clocks[frame.camera]
        if (irregular_s := min(1e-9 * clock.check.sigma_ns, MAX_CLOCK_ERROR_S)) > REGULAR_S:
            clock.report_irregular(name, irregular_s)
            in_common_s = math.sqrt(max(0.0, frame.clock_sigma_s**2 - irregular_s**2))
            frame = replace(frame, stamp_sigma_s=irregular_s, clock_sigma_s=in_common_s)
        if clock.since_ns or clock.known_s:
            correction_s, sigma_s = clock.at(frame.t_ns), math.hypot(frame.clock_sigma_s, clock.known_s)
            if clock.is_off and abs(correction_s - clock.reported_s) > REPORTED_S + abs(clock.reported_s):
                clock.reported_s = correction_s
                log.warning(
                    "camera %s: its clock drifts from the others by %.0f ppm; its stamps are corrected, now by %.1f ms",
                    *(name, -1e6 * clock.rate, 1e3 * correction_s),
                    extra=about(name),
                )
            frame = replace(frame, t_ns=frame.t_ns + round(1e9 * correction_s), clock_sigma_s=sigma_s)
        return None if frame.t_ns > frame.received_ns + MAX_AHEAD_NS else frame

    def rate(self, name: str) -> float:
        """By which the correction of a camera's stamps grows."""
        return self._clocks[name].rate

    def correct(self, departure: Departure) -> None:
        """Correct the clock of a camera that departs from the others."""
        clock, t_ns = self._clocks[self._names[departure.camera]], departure.t_ns
        clock.correction_s, clock.since_ns = clock.at(t_ns) + departure.offset_s, t_ns
        clock.rate, clock.sigma_s = clock.rate + departure.rate, departure.sigma_s
        clock.rate_sigma = departure.rate_sigma

    def doubt(self, offsets_s: Mapping[str, float]) -> None:
        """Count offsets that robots may show, by camera, as uncertainty of their clocks; others are not in doubt."""
        for name, clock in self._clocks.items():
            clock.doubt_s = offsets_s.get(name, 0.0)

    def hold_common(self, t_ns: int) -> None:
        """Let no rate be common to most clocks from a time on, and let an offset that is decay: robots show differences
        only, and each departure may leave a part of its offset and rate with the others, which would move all robots
        along their paths for ever."""
        if rate := _common([clock.rate for clock in self._clocks.values()]):
            for clock in self._clocks.values():
                clock.correction_s, clock.since_ns = clock.at(t_ns), t_ns
                clock.rate -= rate
        passed_s, self._held_ns = max(0, t_ns - (self._held_ns or t_ns)) * 1e-9, t_ns
        offset_s = _common([clock.unexplained_s(t_ns) for clock in self._clocks.values()])
        for clock in self._clocks.values() if offset_s else ():
            clock.correction_s += offset_s * math.expm1(-passed_s / DECAY_S)
            clock.since_ns = clock.since_ns or t_ns  # corrected from now on


def _common(values: Sequence[float]) -> float:
    """What most values have in common: of their medians the one nearest to none."""
    return min(max(0.0, median_low(values)), median_high(values))


def uncertain(frame_set: FrameSet, speed_m_s: float) -> set[str]:
    """Cameras of a frame set whose time is not known well enough to locate robots at this speed, while that of two
    others is: by what the frames state, so that a replay repeats it."""
    found = {f.camera for f in frame_set.frames if f.time_sigma_s * speed_m_s > MAX_MOTION_M}
    return found if len({f.camera for f in frame_set.frames}) > len(found) + 1 else set()
