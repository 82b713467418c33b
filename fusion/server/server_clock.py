# SPDX-License-Identifier: BSD-3-Clause
"""The server's time: Unix time when the server started, and since then the monotonic clock.

Setting the machine's clock changes neither this time nor, through `ClockReply`, the stamps of any camera.
"""

import time

import zenoh

from camera_node.clocks.host_clock import clock_id, unix_ahead_ns
from camera_node.node.clock_sync import ClockSync
from camera_node.protocol.messages import ClockReply, Keys


class ServerClock:
    """The time of all messages of an arena.

    Attributes:
        ahead_ns: this time minus the machine's monotonic clock; constant.
    """

    def __init__(self) -> None:
        self.ahead_ns = unix_ahead_ns()

    def now_ns(self) -> int:
        """The present time, ns since 1970; never goes back."""
        return time.monotonic_ns() + self.ahead_ns

    def reply(self) -> ClockReply:
        """The answer to a query for the time."""
        return ClockReply(t_ns=self.now_ns(), clock=clock_id(), monotonic_ahead_ns=self.ahead_ns)

    @property
    def is_known(self) -> bool:
        """True; as `ClockSync.is_known`."""
        return True

    def close(self) -> None:
        """Nothing to close; as `ClockSync.close`."""


def clock_of(leads: bool, session: zenoh.Session, keys: Keys) -> ServerClock | ClockSync:
    """The first zone's server defines the arena's time; the others follow it, as cameras do."""
    return ServerClock() if leads else ClockSync(session, keys).start()
