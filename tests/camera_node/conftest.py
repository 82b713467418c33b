# SPDX-License-Identifier: BSD-3-Clause
"""Fixtures: Zenoh routers and clients on loopback, and waiting with a deadline."""

import threading
import time
from collections.abc import Callable, Iterator

import pytest
import zenoh

from camera_node.errors import NetworkError
from camera_node.protocol.session import open_client, open_router
from tests.conftest import free_port

DEADLINE_S = 15.0  # enough for a loaded machine; only a failing test waits this long


class Inbox:
    """Collects the arguments of a Zenoh callback, and waits for them."""

    def __init__(self) -> None:
        self.items: list = []
        self._changed = threading.Condition()

    def put(self, item: object) -> None:
        with self._changed:
            self.items.append(item)
            self._changed.notify_all()

    def until(self, happened: Callable[[list], object]) -> bool:
        """Wait until `happened(items)` is true; return False after the deadline."""
        with self._changed:
            return bool(self._changed.wait_for(lambda: happened(self.items), DEADLINE_S))


def eventually(happened: Callable[[], object], act: Callable[[], object] = lambda: None) -> bool:
    """Call `act` every 10 ms until `happened()` is true; return False after the deadline."""
    pause, end = threading.Event(), time.monotonic() + DEADLINE_S
    while not happened() and time.monotonic() < end:
        act()
        pause.wait(0.01)
    return bool(happened())


class Network:
    """Routers and clients that are closed when the test ends."""

    def __init__(self) -> None:
        self._sessions: list[zenoh.Session] = []
        self.endpoint = f"tcp/127.0.0.1:{free_port()}"

    def router(self) -> zenoh.Session:
        """Open a router at `endpoint`, or at a new endpoint where another process has taken the port."""
        for _ in range(20):
            try:
                return self._register(open_router([self.endpoint]))
            except NetworkError:
                self.endpoint = f"tcp/127.0.0.1:{free_port()}"
        raise AssertionError("twenty consecutive ports were taken")

    def router_again(self) -> zenoh.Session:
        """Open a router at the endpoint to which the clients connect."""
        return self._register(open_router([self.endpoint]))

    def client(self) -> zenoh.Session:
        return self._register(open_client([self.endpoint]))

    def _register(self, session: zenoh.Session) -> zenoh.Session:
        self._sessions.append(session)
        return session

    def close(self) -> None:
        for session in reversed(self._sessions):
            session.close()


@pytest.fixture
def network() -> Iterator[Network]:
    network = Network()
    yield network
    network.close()


@pytest.fixture(name="eventually")
def _eventually() -> Callable[..., bool]:
    return eventually


@pytest.fixture
def inbox() -> Callable[[], Inbox]:
    return Inbox
