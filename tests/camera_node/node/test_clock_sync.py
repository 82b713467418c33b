# SPDX-License-Identifier: BSD-3-Clause
"""Clock synchronization over Zenoh on loopback: exact for a shared clock, otherwise within its error bound."""

import time
from collections.abc import Callable, Iterator

import pytest

from camera_node.clocks.host_clock import clock_id, unix_ahead_ns
from camera_node.node.clock_sync import ClockSync
from camera_node.protocol.messages import ClockReply, Keys, encode

KEYS = Keys("test")
READING_NS = 100_000  # between the readings of two clocks on a busy machine
HOUR_NS = 3600 * 10**9
Start = Callable[[Callable[[], ClockReply]], ClockSync]


@pytest.fixture
def started(network) -> Iterator[Start]:
    """Start a ClockSync and a server with a given reply."""
    clocks: list[ClockSync] = []

    def start(answer: Callable[[], ClockReply]) -> ClockSync:
        session = network.router()
        session.declare_queryable(KEYS.clock, lambda query: query.reply(KEYS.clock, encode(answer())))
        clocks.append(ClockSync(session, KEYS).start())
        return clocks[-1]

    yield start
    for clock in clocks:
        clock.close()


def test_a_clock_that_is_shared_needs_no_estimate(started: Start, eventually):
    """On one machine the server's time follows from the monotonic clock, whatever the system clock shows."""
    if not clock_id():
        pytest.skip("this system has no boot id")
    ahead_ns = unix_ahead_ns() + HOUR_NS
    clock = started(lambda: ClockReply(time.monotonic_ns() + ahead_ns, clock_id(), ahead_ns))
    assert eventually(lambda: (clock.estimate() or (0, 1.0))[1] == 0.0)
    before = time.monotonic_ns()
    assert before + ahead_ns - READING_NS <= clock.now_ns() <= time.monotonic_ns() + ahead_ns + READING_NS


@pytest.mark.parametrize("name", ["", "another machine's", clock_id()])
@pytest.mark.parametrize("monotonic_ahead_ns", [None, HOUR_NS])
def test_another_clock_is_estimated(started: Start, eventually, name: str, monotonic_ahead_ns: int | None):
    """With any name: a running virtual machine that was copied has the same clock id but another time."""
    clock = started(lambda: ClockReply(time.time_ns() + HOUR_NS, name, monotonic_ahead_ns))
    assert eventually(clock.estimate)
    offset_ns, bound_ns = clock.estimate() or (0, 0)
    assert abs(offset_ns - HOUR_NS) <= bound_ns
    assert 0 < bound_ns < HOUR_NS


def test_a_server_that_moves_to_another_machine_is_followed(started: Start, eventually):
    ahead_ns = [0]
    clock = started(lambda: ClockReply(time.time_ns() + ahead_ns[0], clock_id() if not ahead_ns[0] else ""))
    assert eventually(clock.estimate)
    ahead_ns[0] = HOUR_NS
    assert eventually(lambda: abs((clock.estimate() or (0, 0))[0] - HOUR_NS) < 1e9)


def test_invalid_replies_are_ignored(started: Start, eventually):
    """Until the first valid reply there is no estimate, and times are unchanged."""
    asked: list[int] = []

    def answer() -> ClockReply:
        asked.append(1)
        return ClockReply("noon" if len(asked) < 3 else time.time_ns())  # pyright: ignore[reportArgumentType] invalid on purpose

    clock = started(answer)
    assert clock.to_server(5) == 5
    assert eventually(clock.estimate)
    assert len(asked) >= 3


def test_unix_time_follows_from_the_monotonic_clock():
    """It lies between two readings of Unix time, within 1 us for rounding."""
    before = time.time_ns()
    derived = time.monotonic_ns() + unix_ahead_ns()
    assert before - 1000 <= derived <= time.time_ns() + 1000
