# SPDX-License-Identifier: BSD-3-Clause
"""Capture time in the server's time: round trips over Zenoh, as NTP does over UDP, or the clock that both share."""

import logging
import threading
import time

import zenoh

from camera_node.node.clock_offset import READING_NS, OffsetEstimator, RoundTrip
from camera_node.protocol.host_clock import clock_id, unix_ahead_ns
from camera_node.protocol.messages import ClockReply, Keys, MessageError, decode

log = logging.getLogger("camera_node.clock")

PERIOD_S = 1.0
FIRST_PERIOD_S = 0.125  # while the server does not answer; then it doubles until it is PERIOD_S
BURST = 3  # round trips a period
TIMEOUT_S = 0.5


class ClockSync:
    """Keeps an estimate of the server's clock fresh, in a thread of its own, from `start` to `close`.

    The server's clock is compared with the monotonic one, so that setting this machine's clock changes no stamp.
    """

    def __init__(self, session: zenoh.Session, keys: Keys) -> None:
        self._querier = session.declare_querier(
            keys.clock,
            timeout=TIMEOUT_S,
            consolidation=zenoh.ConsolidationMode.NONE,  # hand over the first reply at once
            priority=zenoh.Priority.REAL_TIME,
            express=True,
        )
        self._estimator = OffsetEstimator()
        self._shared = False  # whether the server's clock is this machine's
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
        """The server's clock less this machine's, and its error bound, nanoseconds; None until the server answered.

        Args:
            t_ns: when, in this machine's Unix time; now unless given.
        """
        ahead_ns = unix_ahead_ns()
        monotonic_ns = time.monotonic_ns() if t_ns is None else t_ns - ahead_ns
        with self._lock:
            if self._shared:
                return 0, 0.0
            told = self._estimator.at(monotonic_ns)
        return told and (told[0] - ahead_ns, told[1])

    def to_server(self, t_ns: int) -> int:
        """A time of this machine's in the server's; as it is until the server answered."""
        estimate = self.estimate(t_ns)
        return t_ns + estimate[0] if estimate else t_ns

    def _run(self) -> None:
        pause_s = FIRST_PERIOD_S
        while not self._closed.is_set():
            pause_s = min(2 * pause_s, PERIOD_S) if self._refresh() else FIRST_PERIOD_S
            self._closed.wait(pause_s)

    def _refresh(self) -> bool:
        """Ask the server a few times, or once where it has this machine's clock; whether it answered."""
        trips, shared = [], False
        while len(trips) < BURST and not shared and not self._closed.is_set() and (told := self._ask()):
            trips.append(told[0])
            shared = told[1]
        if trips:
            with self._lock:
                self._shared = shared
                self._estimator.add(*trips)
        return bool(trips)

    def _ask(self) -> tuple[RoundTrip, bool] | None:
        """A round trip, by the monotonic clock, and whether the server's clock is this machine's."""
        sent = time.monotonic_ns()
        try:
            for reply in self._querier.get():
                received = time.monotonic_ns()
                if reply.ok:
                    told = decode(reply.ok.payload.to_bytes(), ClockReply)
                    return RoundTrip(sent, told.t_ns, received), _is_shared(told, sent, received)
        except (zenoh.ZError, MessageError) as error:
            log.debug("no server time: %s", error)
        return None


def _is_shared(told: ClockReply, sent_ns: int, received_ns: int) -> bool:
    """Whether it is this machine's clock, by its name and by what it shows: copies of a virtual machine share names."""
    if not told.clock or told.clock != clock_id():
        return False
    return sent_ns - READING_NS <= told.t_ns - unix_ahead_ns() <= received_ns + READING_NS
