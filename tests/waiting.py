# SPDX-License-Identifier: BSD-3-Clause
"""Waiting for conditions with a deadline. No test sleeps outside of this module.

A deadline only ends a test that fails. It is given for an idle machine, and is longer where the machine is loaded.
"""

import os
import socket
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TypeVar

T = TypeVar("T")
DEADLINE_S = 120.0
MAX_SLOWNESS = 8.0
MAX_DEADLINE_S = 250.0  # pytest-timeout ends an everyday test after 300 s, without a reason
INTERVAL_S = 0.01


def slowness() -> float:
    """How many times longer than on an idle machine a program takes: processes that are ready to run, per processor."""
    return min(max(1.0, os.getloadavg()[0] / (os.cpu_count() or 1)), MAX_SLOWNESS)


def patient(deadline_s: float) -> float:
    """The deadline on this machine, now, of what takes at most `deadline_s` on an idle one."""
    return max(deadline_s, min(deadline_s * slowness(), MAX_DEADLINE_S))


def poll(
    condition: Callable[[], T], act: Callable[[], object] | None = None, deadline_s: float = DEADLINE_S
) -> T:
    """Call `act` and `condition` every 10 ms until the condition is true or the deadline passes; return its value."""
    begun = time.monotonic()
    while not (value := condition()) and time.monotonic() - begun < patient(deadline_s):
        if act is not None:
            act()
        time.sleep(INTERVAL_S)
    return value


@contextmanager
def in_thread(run: Callable[[], object], end: Callable[[], object]) -> Iterator[None]:
    """Run a function in a thread while the block runs; then `end` is called, which must make it return."""
    thread = threading.Thread(target=run)
    thread.start()
    try:
        yield
    finally:
        end()
        thread.join(DEADLINE_S)
        assert not thread.is_alive(), "the thread does not end"


@contextmanager
def repeating(act: Callable[[], object], interval_s: float = 0.0) -> Iterator[None]:
    """Call `act` again and again in a thread, `interval_s` after its last end, until the block ends."""
    stop = threading.Event()

    def run() -> None:
        while not stop.wait(interval_s):
            act()

    with in_thread(run, stop.set):
        yield


def wait_for(
    condition: Callable[[], T], act: Callable[[], object] | None = None, deadline_s: float = DEADLINE_S
) -> T:
    """Like `poll`, and fail the test if the condition does not become true."""
    value = poll(condition, act, deadline_s)
    assert value, f"the condition did not become true within {patient(deadline_s):.0f} s"
    return value


def wait_for_port(port: int, deadline_s: float = DEADLINE_S) -> None:
    """Wait until a program listens on a TCP port of this machine."""

    def connects() -> bool:
        try:
            socket.create_connection(("127.0.0.1", port), timeout=1).close()
        except OSError:
            return False
        return True

    wait_for(connects, deadline_s=deadline_s)


class Inbox:
    """Collects what a callback receives, from any thread."""

    def __init__(self) -> None:
        self.items: list = []
        self._changed = threading.Condition()

    def put(self, item: object) -> None:
        with self._changed:
            self.items.append(item)
            self._changed.notify_all()

    def until(self, condition: Callable[[list], object], deadline_s: float = DEADLINE_S) -> bool:
        """Wait until `condition(items)` is true; return whether it became so within the deadline."""
        with self._changed:
            return bool(self._changed.wait_for(lambda: condition(self.items), patient(deadline_s)))
