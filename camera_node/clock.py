# SPDX-License-Identifier: BSD-3-Clause
"""Capture time in the server's time: round trips over Zenoh, as NTP does over UDP."""

import logging
import threading
import time
from collections import deque
from dataclasses import dataclass

import zenoh

from camera_node.messages import ClockReply, Keys, MessageError, decode

log = logging.getLogger("camera_node.clock")

WINDOW_NS = 60_000_000_000  # how long a round trip is remembered
DRIFT = 100e-6  # two clocks of 50 ppm each, running apart
SLEW = 500e-6  # how fast an estimate may move; NTP's own limit
PERIOD_S = 1.0
BURST = 3  # round trips a period; the quickest counts
TIMEOUT_S = 0.5


@dataclass(frozen=True, slots=True)
class RoundTrip:
    """One question to the server: this machine's times around the server's."""

    sent_ns: int
    server_ns: int
    received_ns: int

    @property
    def offset_ns(self) -> float:
        """The server's clock less this machine's, were both ways equally long."""
        return (2 * self.server_ns - self.sent_ns - self.received_ns) / 2

    def error_ns(self, now_ns: int) -> float:
        """How far the truth may be from `offset_ns`: all delay was on one way, and the clocks drifted since."""
        return (self.received_ns - self.sent_ns) / 2 + DRIFT * max(0, now_ns - self.sent_ns)


class OffsetEstimator:
    """The server's clock less this machine's, with a bound that holds while clocks drift less than `DRIFT`.

    The round trip with the least error bound in the window decides (Mills, RFC 5905, section 10: the minimum-delay
    sample). The estimate slews there. Only when a new round trip contradicts it, because somebody set a clock, is
    the past forgotten and the estimate jumps.
    """

    def __init__(self) -> None:
        self._trips: deque[RoundTrip] = deque()
        self._start: tuple[int, float] | None = None  # where the slewing began: this machine's time, offset

    def add(self, trip: RoundTrip) -> None:
        """Learn from a round trip; one that goes backwards in time is ignored."""
        if trip.received_ns < trip.sent_ns:
            return
        now = trip.received_ns
        start = self.at(now)
        if self._trips and self._contradicts(trip, now):
            self._trips.clear()
            start = None
        while self._trips and not 0 <= now - self._trips[0].received_ns <= WINDOW_NS:
            self._trips.popleft()
        self._trips.append(trip)
        self._start = (now, start[0] if start else trip.offset_ns)

    def at(self, now_ns: int) -> tuple[float, float] | None:
        """The offset and its error bound, nanoseconds, at this machine's time; None before the first round trip."""
        if self._start is None:
            return None
        best = self._best(now_ns)
        begun, offset = self._start
        reach = SLEW * max(0, now_ns - begun)
        offset += min(max(best.offset_ns - offset, -reach), reach)
        return offset, best.error_ns(now_ns) + abs(best.offset_ns - offset)

    def _best(self, now_ns: int) -> RoundTrip:
        return min(self._trips, key=lambda trip: trip.error_ns(now_ns))

    def _contradicts(self, trip: RoundTrip, now_ns: int) -> bool:
        best = self._best(now_ns)
        return abs(best.offset_ns - trip.offset_ns) > best.error_ns(now_ns) + trip.error_ns(now_ns)


class Clock:
    """Keeps an estimate of the server's clock fresh, in a thread of its own, from `start` to `close`."""

    def __init__(self, session: zenoh.Session, keys: Keys) -> None:
        self._querier = session.declare_querier(
            keys.clock,
            timeout=TIMEOUT_S,
            consolidation=zenoh.ConsolidationMode.NONE,  # hand over the first reply at once
            priority=zenoh.Priority.REAL_TIME,
            express=True,
        )
        self._estimator = OffsetEstimator()
        self._lock = threading.Lock()
        self._closed = threading.Event()
        self._thread = threading.Thread(target=self._run, name="clock", daemon=True)

    def start(self) -> "Clock":
        self._thread.start()
        return self

    def close(self) -> None:
        self._closed.set()
        self._thread.join(2 * BURST * TIMEOUT_S)

    def estimate(self) -> tuple[float, float] | None:
        """The server's clock less this machine's, and its error bound, nanoseconds; None until the server answered."""
        with self._lock:
            return self._estimator.at(time.time_ns())

    def to_server(self, t_ns: int) -> int:
        """A time of this machine's in the server's; as it is until the server answered."""
        estimate = self.estimate()
        return t_ns + round(estimate[0]) if estimate else t_ns

    def _run(self) -> None:
        while not self._closed.wait(PERIOD_S if self._refresh() else PERIOD_S / 4):
            pass

    def _refresh(self) -> bool:
        """Ask the server a few times; whether it answered."""
        trips = [trip for _ in range(BURST) if not self._closed.is_set() and (trip := self._ask())]
        with self._lock:
            for trip in trips:
                self._estimator.add(trip)
        return bool(trips)

    def _ask(self) -> RoundTrip | None:
        sent = time.time_ns()
        try:
            for reply in self._querier.get():
                received = time.time_ns()
                if reply.ok:
                    return RoundTrip(sent, decode(reply.ok.payload.to_bytes(), ClockReply).t_ns, received)
        except (zenoh.ZError, MessageError) as error:
            log.debug("no server time: %s", error)
        return None
