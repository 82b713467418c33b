# SPDX-License-Identifier: BSD-3-Clause
"""How far the server's clock is ahead of this machine's, from round trips that queues delayed on either way.

When a question leaves, the server's clock shows no more than what the answer says; when the answer comes, no less
(Marzullo and Owicki 1983). Each way by itself so bounds the offset from one side, and a queue only loosens its own
bound: the quickest questions and the quickest answers tell, whichever round trips they belong to. Between them runs
the drift, as Moon, Skelly and Towsley (INFOCOM 1999) find it from the lower envelope of one-way delays, here of both.
The middle between both bounds is the estimate: nothing else is nearer in the worst case, and for random delays of
equal law it has the greatest likelihood (Jeske, IEEE Trans. Communications 2005).
"""

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from camera_node.arrays import Array

WINDOW_NS = 300_000_000_000  # how long a round trip is remembered: longer than a bad minute
DRIFT = 100e-6  # two clocks of 50 ppm each, running apart
WANDER = 5e-6  # by which that changes within the window, by warmth and by time services
READING_NS = 1000  # how finely clocks are read, at worst


@dataclass(frozen=True, slots=True)
class RoundTrip:
    """One question to the server: this machine's times, monotonic, around the server's."""

    sent_ns: int
    server_ns: int
    received_ns: int


@dataclass(frozen=True, slots=True)
class Band:
    """Where the offset lies: `low` to `high` above `offset_ns` at `t_ns`, growing by `slowest` to `fastest` ns a ns."""

    t_ns: int
    offset_ns: int
    low: float
    high: float
    slowest: float
    fastest: float

    def at(self, t_ns: int) -> tuple[int, float]:
        """Its middle, and half its width, nanoseconds."""
        passed = t_ns - self.t_ns
        middle = (self.low + self.high + (self.slowest + self.fastest) * passed) / 2
        width = self.high - self.low + (self.fastest - self.slowest) * abs(passed)
        return self.offset_ns + round(middle), width / 2


@dataclass(frozen=True, slots=True)
class Limit:
    """What the offset is at most, or at least, at one time."""

    t_ns: int
    offset_ns: int


class OffsetEstimator:
    """The server's clock less this machine's, with a bound that holds while the clocks' drift is below `DRIFT` and
    changes by less than `WANDER`.

    Round trips that contradict each other mean that somebody set a clock: the older half is forgotten until the rest
    agree. One by one would leave those that only just agree, and a band that is narrow for being wrong.
    The estimate is the best at any time and does not slew, as what it stamps are measurements and no timers.
    """

    def __init__(self) -> None:
        self._limits: deque[tuple[Limit, Limit]] = deque()  # most and least, of each burst
        self._band: Band | None = None

    def add(self, *burst: RoundTrip) -> None:
        """Learn from one or more round trips that were made at once, after all others."""
        questions = [Limit(trip.sent_ns, trip.server_ns - trip.sent_ns) for trip in burst]
        answers = [Limit(trip.received_ns, trip.server_ns - trip.received_ns) for trip in burst]
        self._limits.append((min(questions, key=_offset), max(answers, key=_offset)))
        now_ns = answers[-1].t_ns
        while now_ns - self._limits[0][0].t_ns > WINDOW_NS:
            self._limits.popleft()
        while (band := find_band(self._limits, now_ns)) is None and self._limits:
            for _ in range((len(self._limits) + 1) // 2):
                self._limits.popleft()
        self._band = band

    def at(self, t_ns: int) -> tuple[int, float] | None:
        """The offset and its error bound, nanoseconds, at this machine's time; None before the first round trip."""
        return self._band.at(t_ns) if self._band else None


def _offset(limit: Limit) -> int:
    return limit.offset_ns


def find_band(limits: Sequence[tuple[Limit, Limit]], now_ns: int) -> Band | None:
    """Where the offset lies now, by what it was at most and at least; None where they leave no place, or are none."""
    if not limits:
        return None
    origin_ns = limits[-1][0].offset_ns  # numbers count from it, and from now: nothing is lost in rounding
    (asked, high), (answered, low) = (
        np.array([(limit.t_ns - now_ns, limit.offset_ns - origin_ns) for limit in column], float).T
        for column in zip(*limits, strict=True)
    )
    high, low = high + READING_NS, low - READING_NS
    slowest, fastest = _rates(asked, high, answered, low)
    top = float((high - fastest * asked).min())
    bottom = float((low - slowest * answered).max())
    if slowest > fastest or bottom > top:
        return None
    return Band(now_ns, origin_ns, bottom, top, slowest, fastest)


def _rates(asked: Array, high: Array, answered: Array, low: Array) -> tuple[float, float]:
    """The least and the greatest rate at which the offset may grow at any time of the window.

    From the question i to the answer j it grows by low_j - high_i or more. That bounds its mean rate between them, from
    below where the answer came after, and from above where it came before.
    """
    span = answered[None, :] - asked[:, None]
    with np.errstate(divide="ignore", invalid="ignore"):  # where both were at one time, which tells nothing
        rate = (low[None, :] - high[:, None]) / span
    least = rate.max(where=span > 0, initial=-np.inf)
    most = rate.min(where=span < 0, initial=np.inf)
    return max(-DRIFT, float(least) - WANDER), min(DRIFT, float(most) + WANDER)
