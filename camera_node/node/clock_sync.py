# SPDX-License-Identifier: BSD-3-Clause
"""Converts this machine's time to the server's: by round trips over Zenoh, or directly where both share one clock.

`camera_node.clocks.clock_offset` estimates the offset; docs/design/clock_offset.md describes the method.
"""

import logging
import threading
import time

import zenoh

from camera_node.clocks.clock_offset import READING_NS, OffsetEstimator, RoundTrip
from camera_node.clocks.host_clock import clock_id, unix_ahead_ns
from camera_node.protocol.messages import ClockReply, Keys, MessageError, decode
from camera_node.protocol.session import is_from_router

log = logging.getLogger("camera_node.clock")

PERIOD_S = 1.0
FIRST_PERIOD_S = 0.125  # while the server does not answer; then it doubles up to PERIOD_S
BURST = 3  # round trips in each period
TIMEOUT_S = 0.5


class ClockSync:
    """Updates the estimate of the server's clock in a thread of its own, from `start` to `close`.

    The estimate is relative to the monotonic clock, so that setting this machine's clock changes no stamp.
    """

    def __init__(self, session: zenoh.Session, keys: Keys) -> None:
        self._session = session
        self._querier = session.declare_querier(
            keys.clock,
            timeout=TIMEOUT_S,
            consolidation=zenoh.ConsolidationMode.NONE,  # deliver the first reply at once
            priority=zenoh.Priority.REAL_TIME,
            congestion_control=zenoh.CongestionControl.DROP,  # a query that waits for a full link blocks the session
            express=True,
        )
        self._estimator = OffsetEstimator()
        self._shared_ahead_ns: int | None = None  # server time minus the monotonic clock that both share
        self._lock = threading.Lock()
        self._closed = threading.Event()
        self._thread = threading.Thread(target=self._run, name="clock", daemon=True)

    def start(self) -> "ClockSync":
        self._thread.start()
        return self

    def close(self) -> None:
        self._closed.set()
        self._thread.join(2 * BURST * TIMEOUT_S)

    def estimate(self, t_ns: int | None = None) -> tuple[int, float] | None:
        """The server's clock minus this machine's and the error bound, ns; None until the server answers.

        Args:
            t_ns: the time of interest, this machine's Unix time; now unless given.
        """
        ahead_ns = unix_ahead_ns()
        monotonic_ns = time.monotonic_ns() if t_ns is None else t_ns - ahead_ns
        with self._lock:
            shared_ahead_ns, estimate = self._shared_ahead_ns, self._estimator.at(monotonic_ns)
        if shared_ahead_ns is not None:
            return shared_ahead_ns - ahead_ns, 0.0
        return estimate and (estimate[0] - ahead_ns, estimate[1])

    @property
    def is_known(self) -> bool:
        """Whether the server has answered."""
        return self.estimate() is not None

    def to_server(self, t_ns: int) -> int:
        """Convert this machine's Unix time to the server's; unchanged until the server answers."""
        estimate = self.estimate(t_ns)
        return t_ns + estimate[0] if estimate else t_ns

    def now_ns(self) -> int:
        """The server's present time."""
        return self.to_server(time.time_ns())

    def _run(self) -> None:
        pause_s = FIRST_PERIOD_S
        while not self._closed.is_set():
            try:
                has_answer = self._refresh()
            except Exception:  # whatever a reply can cause: the next one is another
                log.exception("the server's time could not be processed")
                has_answer = True  # no fast retry
            pause_s = min(2 * pause_s, PERIOD_S) if has_answer else FIRST_PERIOD_S
            self._closed.wait(pause_s)

    def _refresh(self) -> bool:
        """Ask the server `BURST` times, or once where it uses this machine's clock; return whether it answered."""
        trips, ahead_ns = [], None
        while (
            len(trips) < BURST and ahead_ns is None and not self._closed.is_set() and (reply := self._ask())
        ):
            trips.append(reply[0])
            ahead_ns = reply[1]
        if trips:
            with self._lock:
                self._shared_ahead_ns = ahead_ns
                self._estimator.add(*trips)
        return bool(trips)

    def _ask(self) -> tuple[RoundTrip, int | None] | None:
        """A round trip, and the server's time minus the monotonic clock if both share that; None without a reply.

        Other clients may answer too, unless access control forbids it: the router's reply is used, if there is one.
        """
        answer = None
        sent_ns = time.monotonic_ns()
        try:
            for reply in self._querier.get():
                received_ns = time.monotonic_ns()
                answer = _parse(reply, sent_ns, received_ns) or answer
                if is_from_router(self._session, reply):
                    break
        except zenoh.ZError as error:
            log.debug("no server time: %s", error)
        return answer


def _parse(reply: zenoh.Reply, sent_ns: int, received_ns: int) -> tuple[RoundTrip, int | None] | None:
    """As `ClockSync._ask`, of one reply; None of an invalid one."""
    if reply.ok is None:
        return None
    try:
        message = decode(reply.ok.payload.to_bytes(), ClockReply)
    except MessageError as error:
        log.debug("no server time: %s", error)
        return None
    trip = RoundTrip(sent_ns, message.t_ns, received_ns)
    return trip, message.monotonic_ahead_ns if _is_shared(message, trip) else None


def _is_shared(reply: ClockReply, trip: RoundTrip) -> bool:
    """Whether the server reads the monotonic clock of this machine; copies of a virtual machine share ids."""
    if not reply.clock or reply.clock != clock_id() or reply.monotonic_ahead_ns is None:
        return False
    return trip.sent_ns - READING_NS <= reply.t_ns - reply.monotonic_ahead_ns <= trip.received_ns + READING_NS
