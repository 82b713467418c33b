# SPDX-License-Identifier: BSD-3-Clause
"""Converts the time stamps of a camera with a clock of its own to this machine's Unix time.

Where the camera's clock can be read, round trips bound its offset and drift, as for the clock of the server (see
`clock_offset`). Where it can't, the frames that arrive fastest define the offset (see `arrival_clock`).
"""

import time
from collections.abc import Callable

from camera_node.clocks.arrival_clock import ArrivalClock
from camera_node.clocks.clock_offset import OffsetEstimator, RoundTrip
from camera_node.clocks.host_clock import unix_ahead_ns

PERIOD_NS = 1_000_000_000
BURST = 3  # readings in each period; the fastest ones bound the offset
FIRST_BURST = 16


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
