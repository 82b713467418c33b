# SPDX-License-Identifier: BSD-3-Clause
"""Waiting for conditions with a deadline. No test sleeps outside of this module."""

import socket
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TypeVar

T = TypeVar("T")
DEADLINE_S = 60.0  # for a loaded machine; a test waits as long only if it fails
INTERVAL_S = 0.01


def poll(
    condition: Callable[[], T], act: Callable[[], object] | None = None, deadline_s: float = DEADLINE_S
) -> T:
    """Call `act` and `condition` every 10 ms until the condition is true or the deadline passes; return its value."""
    end = time.monotonic() + deadline_s
    while not (value := condition()) and time.monotonic() < end:
        if act is not None:
            act()
        time.sleep(INTERVAL_S)
    return value


@contextmanager
def repeating(act: Callable[[], object], interval_s: float = 0.0) -> Iterator[None]:
    """Call `act` again and again in a thread, `interval_s` after its last end, until the block ends."""
    stop = threading.Event()

    def run() -> None:
        while not stop.wait(interval_s):
            act()

    thread = threading.Thread(target=run)
    thread.start()
    try:
        yield
    finally:
        stop.set()
        thread.join(DEADLINE_S)


def wait_for(
    condition: Callable[[], T], act: Callable[[], object] | None = None, deadline_s: float = DEADLINE_S
) -> T:
    """Like `poll`, and fail the test if the condition does not become true."""
    value = poll(condition, act, deadline_s)
    assert value, f"the condition did not become true within {deadline_s:.0f} s"
    return value


def wait_for_port(port: int, deadline_s: float = 120.0) -> None:
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
            return bool(self._changed.wait_for(lambda: condition(self.items), deadline_s))
