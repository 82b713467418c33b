# SPDX-License-Identifier: BSD-3-Clause
"""Converts the time stamps of cameras and network streams with clocks of their own to this machine's Unix time.

Where a camera's clock can be read, round trips bound its offset and drift, as for the clock of the server (see
`clock_offset`). Where it can't, the frames that arrive fastest define the offset.

A stream arrives late by a constant and by a varying delay. The constant part is the camera's time offset, which the
wand calibration estimates; `ArrivalClock` estimates the varying part. With time stamps of the sender (RTP), the frames
that arrive fastest define the difference of both clocks, and each frame is stamped with the sender's time. Without them
(MJPEG over HTTP) the arrival itself is the stamp.
"""

import time
from collections import deque
from collections.abc import Callable

import numpy as np

from camera_node.clocks.clock_offset import OffsetEstimator, RoundTrip
from camera_node.clocks.host_clock import unix_ahead_ns

PERIOD_NS = 1_000_000_000
BURST = 3  # readings in each period; the fastest ones bound the offset
FIRST_BURST = 16
WINDOW = 300  # frames: ten seconds at 30 Hz
ENOUGH = 20  # frames before the variation is known
UNKNOWN_US = 100_000.0  # bound of the error until then
LEAST_US = 500.0  # the sender's clock drifts by up to 50 ppm, 0.5 ms in a window
JUMP_NS = 1_000_000_000  # beyond this, the sender restarted its clock
INTERVALS = 0.95  # share of the intervals between arrivals whose deviation is within the bound
FASTEST = 0.02  # share of the frames that arrive within the bound after the fastest one


class DeviceClock:
    """The clock of one camera, from its opening on.

    Args:
        ask: reads the camera's clock; `server_ns` of the round trip is its time. None where it can't be read.
    """

    def __init__(self, ask: Callable[[], RoundTrip] | None) -> None:
        self._ask = ask
        self._estimator, self._arrivals = OffsetEstimator(), ArrivalClock()
        self._next_ns = 0
        self._burst = FIRST_BURST

    def refresh(self) -> None:
        """Read the camera's clock if that is due; raises what `ask` raises."""
        if self._ask is None or time.monotonic_ns() < self._next_ns:
            return
        self._estimator.add(*(self._ask() for _ in range(self._burst)))
        self._burst = BURST
        self._next_ns = time.monotonic_ns() + PERIOD_NS

    def to_unix(self, device_ns: int) -> tuple[int, float]:
        """This machine's Unix time of a stamp of the frame that just arrived, ns, and the bound of its error, us."""
        now_ns, ahead_ns = time.monotonic_ns(), unix_ahead_ns()
        estimate = self._estimator.at(now_ns)
        if estimate is None:
            return self._arrivals.stamp(now_ns + ahead_ns, device_ns)
        offset_ns, error_ns = estimate
        return device_ns - offset_ns + ahead_ns, error_ns / 1000


class ArrivalClock:
    """Stamps the frames of one stream."""

    def __init__(self) -> None:
        self._values: deque[int] = deque(maxlen=WINDOW)  # delays, or without the sender's times the arrivals
        self._has_media_times: bool | None = None

    def stamp(self, arrived_ns: int, media_ns: int | None) -> tuple[int, float]:
        """A frame's time and the bound of its varying error.

        Args:
            arrived_ns: when the frame arrived, this machine's Unix time.
            media_ns: the sender's time of the frame, from any epoch; None where it sends none.

        Returns:
            this machine's Unix time, ns, later than the capture by a constant; and the bound, microseconds.
        """
        has_media_times = media_ns is not None
        if has_media_times != self._has_media_times:
            self._values.clear()
            self._has_media_times = has_media_times
        if media_ns is None:
            self._values.append(arrived_ns)
            return arrived_ns, self._bound_of_arrivals()
        delay = arrived_ns - media_ns
        if self._values and abs(delay - self._values[-1]) > JUMP_NS:
            self._values.clear()
        self._values.append(delay)
        return media_ns + min(self._values), self._bound_of_delays()

    def _bound_of_arrivals(self) -> float:
        if len(self._values) < ENOUGH:
            return UNKNOWN_US
        intervals = np.diff(np.array(self._values))
        deviations = np.abs(intervals - np.median(intervals))
        return LEAST_US + float(np.quantile(deviations, INTERVALS)) / 1000

    def _bound_of_delays(self) -> float:
        if len(self._values) < ENOUGH:
            return UNKNOWN_US
        delays = np.array(self._values)
        return LEAST_US + float(np.quantile(delays, FASTEST) - delays.min()) / 1000
