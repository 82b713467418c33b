# SPDX-License-Identifier: BSD-3-Clause
"""The clock: exact where the server has the same one, else within its bound; over Zenoh on loopback."""

import time
from collections.abc import Callable, Iterator

import pytest

from camera_node.node.clock_sync import ClockSync
from camera_node.protocol.host_clock import clock_id, unix_ahead_ns
from camera_node.protocol.messages import ClockReply, Keys, encode

KEYS = Keys("test")
HOUR_NS = 3600 * 10**9
Start = Callable[[Callable[[], ClockReply]], ClockSync]


@pytest.fixture
def started(network) -> Iterator[Start]:
    """Starts a clock beside a server that answers in a given way."""
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
    """On one machine a stamp stays what it is, to the nanosecond, and so it claims."""
    if not clock_id():
        pytest.skip("this system has no boot id")
    clock = started(lambda: ClockReply(time.time_ns(), clock_id()))
    assert eventually(lambda: clock.estimate() == (0, 0.0))
    t_ns = time.time_ns()
    assert clock.to_server(t_ns) == t_ns


@pytest.mark.parametrize("name", ["", "another machine's", clock_id()])
def test_another_clock_is_estimated(started: Start, eventually, name: str):
    """Whatever it is called: a virtual machine that was copied while it ran has the name, but not the time."""
    clock = started(lambda: ClockReply(time.time_ns() + HOUR_NS, name))
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


def test_a_server_that_speaks_nonsense_is_no_server(started: Start, eventually):
    """Until it makes sense: nothing is known, and stamps stay what they are."""
    asked: list[int] = []

    def answer() -> ClockReply:
        asked.append(1)
        return ClockReply("noon" if len(asked) < 3 else time.time_ns())  # pyright: ignore[reportArgumentType] nonsense

    clock = started(answer)
    assert clock.to_server(5) == 5
    assert eventually(clock.estimate)
    assert len(asked) >= 3


def test_both_clocks_are_read_at_one_time():
    """Unix time as it follows from the monotonic clock lies between two readings of it; 1 us is for rounding."""
    before = time.time_ns()
    told = time.monotonic_ns() + unix_ahead_ns()
    assert before - 1000 <= told <= time.time_ns() + 1000
