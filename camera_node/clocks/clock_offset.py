# SPDX-License-Identifier: BSD-3-Clause
"""Estimates the offset and drift between the server's clock and this machine's from round trips of messages.

A request bounds the offset from above and its reply from below, each by its own delay (Marzullo and Owicki 1983). The
drift is bounded by the lower envelopes of both one-way delays (after Moon, Skelly and Towsley, INFOCOM 1999). The
estimate is the middle of the remaining band, which has the least worst-case error and, for equally distributed random
delays, the greatest likelihood (Jeske, IEEE Trans. Communications 2005). docs/design/clock_offset.md derives it.
"""

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from camera_node.foundation.arrays import Array

WINDOW_NS = 300_000_000_000  # age up to which round trips are used; longer than most network disturbances
DRIFT = 100e-6  # largest relative drift: two clocks of 50 ppm each in opposite directions
WANDER = 5e-6  # largest change of the drift within the window, by temperature and time services
BLOCK = (
    32  # replies that are compared with all requests together: a larger matrix grows a node by 3 MB in 300 s
)
READING_NS = 1000  # coarsest resolution of a clock reading


@dataclass(frozen=True, slots=True)
class RoundTrip:
    """One request to the server: this machine's monotonic times before and after it, and the server's time."""

    sent_ns: int
    server_ns: int
    received_ns: int


@dataclass(frozen=True, slots=True)
class OffsetBand:
    """Bounds of the offset over time.

    At `t_ns` the offset lies between `low` and `high` ns above `offset_ns`. Its rate lies between `slowest` and
    `fastest`, in ns per ns.
    """

    t_ns: int
    offset_ns: int
    low: float
    high: float
    slowest: float
    fastest: float

    def at(self, t_ns: int) -> tuple[int, float]:
        """The middle of the band and half its width, ns, at this machine's monotonic time `t_ns`."""
        elapsed = t_ns - self.t_ns
        middle = (self.low + self.high + (self.slowest + self.fastest) * elapsed) / 2
        width = self.high - self.low + (self.fastest - self.slowest) * abs(elapsed)
        return self.offset_ns + round(middle), width / 2


@dataclass(frozen=True, slots=True)
class OffsetLimit:
    """An upper or lower bound of the offset at one time."""

    t_ns: int
    offset_ns: int


class OffsetEstimator:
    """Estimates the server's clock minus this machine's, with an error bound.

    The bound holds while the drift is below `DRIFT` and changes by less than `WANDER`. Round trips that contradict
    each other show that a clock was set: the estimator then discards the older half until the rest agrees. Discarding
    one at a time would keep those that barely agree, and leave a band that is too narrow. The estimate is not slewed,
    because it stamps measurements and drives no timers.
    """

    def __init__(self) -> None:
        self._limits: deque[tuple[OffsetLimit, OffsetLimit]] = (
            deque()
        )  # upper and lower limit from each burst
        self._band: OffsetBand | None = None

    def add(self, *burst: RoundTrip) -> None:
        """Update the estimate with one or more consecutive round trips, which are later than all earlier ones."""
        requests = [OffsetLimit(trip.sent_ns, trip.server_ns - trip.sent_ns) for trip in burst]
        replies = [OffsetLimit(trip.received_ns, trip.server_ns - trip.received_ns) for trip in burst]
        self._limits.append((min(requests, key=_offset), max(replies, key=_offset)))
        now_ns = replies[-1].t_ns
        while now_ns - self._limits[0][0].t_ns > WINDOW_NS:
            self._limits.popleft()
        while (band := find_band(self._limits, now_ns)) is None and self._limits:
            for _ in range((len(self._limits) + 1) // 2):
                self._limits.popleft()
        self._band = band

    def at(self, t_ns: int) -> tuple[int, float] | None:
        """The offset and its error bound, ns, at this machine's monotonic time; None before the first round trip."""
        return self._band.at(t_ns) if self._band else None


def _offset(limit: OffsetLimit) -> int:
    return limit.offset_ns


def find_band(limits: Sequence[tuple[OffsetLimit, OffsetLimit]], now_ns: int) -> OffsetBand | None:
    """Bound the offset and its rate now by upper and lower limits; None where there are none or they contradict."""
    if not limits:
        return None
    origin_ns = limits[-1][0].offset_ns  # relative to it and to now, float64 is exact enough
    (requested, high), (replied, low) = (
        np.array([(limit.t_ns - now_ns, limit.offset_ns - origin_ns) for limit in column], float).T
        for column in zip(*limits, strict=True)
    )
    high, low = high + READING_NS, low - READING_NS
    slowest, fastest = _bound_rate(requested, high, replied, low)
    top = float((high - fastest * requested).min())
    bottom = float((low - slowest * replied).max())
    if slowest > fastest or bottom > top:
        return None
    return OffsetBand(now_ns, origin_ns, bottom, top, slowest, fastest)


def _bound_rate(requested: Array, high: Array, replied: Array, low: Array) -> tuple[float, float]:
    """The smallest and the largest rate that the offset may have at any time of the window.

    From request i to reply j the offset grows by at least low_j - high_i. This bounds its mean rate in between: from
    below where the reply came later than the request, from above where it came earlier.
    """
    least, most = -np.inf, np.inf
    for first in range(0, len(replied), BLOCK):
        block = slice(first, first + BLOCK)
        span = replied[None, block] - requested[:, None]
        with np.errstate(
            divide="ignore", invalid="ignore"
        ):  # equal times carry no information; `where` skips them
            rate = (low[None, block] - high[:, None]) / span
        least = max(least, float(rate.max(where=span > 0, initial=-np.inf)))
        most = min(most, float(rate.min(where=span < 0, initial=np.inf)))
    return max(-DRIFT, least - WANDER), min(DRIFT, most + WANDER)
