# SPDX-License-Identifier: BSD-3-Clause
"""The age of messages at a client: by the server's time, and never less than the time since they arrived."""

import math
import time
from dataclasses import dataclass

import zenoh

from camera_node.node.clock_sync import ClockSync
from camera_node.protocol.messages import Keys
from camera_node.protocol.server_connection import ServerConnection


@dataclass(frozen=True, slots=True)
class ServerTime:
    """One reading of the clocks.

    Attributes:
        latest_ns: the server's time at most, its error bound included; None before the server answered.
        monotonic_s: of this machine.
    """

    latest_ns: int | None
    monotonic_s: float

    def age_s(self, t_ns: int, received_s: float) -> float:
        """The age of a message at most; infinite before the server answered.

        A server that starts again may count from another time until the next round trip: the time since the arrival
        bounds the age then.

        Args:
            t_ns: of which the message speaks, in the server's time.
            received_s: when it arrived, by `time.monotonic`.
        """
        if self.latest_ns is None:
            return math.inf
        return max((self.latest_ns - t_ns) * 1e-9, self.monotonic_s - received_s)


class ServerTimeReader:
    """Reads the server's time from the opening of a connection on, also while the server is away.

    Args:
        connection: to the server.
        keys: of the arena.
    """

    def __init__(self, connection: ServerConnection, keys: Keys) -> None:
        self._keys = keys
        self._clock: ClockSync | None = None
        connection.when_open(self._start)

    def read(self) -> ServerTime:
        """The present time."""
        estimate = self._clock and self._clock.estimate()
        latest_ns = math.ceil(time.time_ns() + sum(estimate)) if estimate else None
        return ServerTime(latest_ns, time.monotonic())

    def now_ns(self) -> int | None:
        """The server's present time, the most probable one; None before it answered."""
        estimate = self._clock and self._clock.estimate()
        return time.time_ns() + estimate[0] if estimate else None

    def close(self) -> None:
        """Ask no more."""
        if self._clock is not None:
            self._clock.close()

    def _start(self, session: zenoh.Session) -> None:
        self._clock = ClockSync(session, self._keys).start()
