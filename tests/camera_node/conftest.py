# SPDX-License-Identifier: BSD-3-Clause
"""Fixtures: Zenoh routers and clients on loopback, and waiting."""

from collections.abc import Callable, Iterator

import pytest
import zenoh

from camera_node.foundation.errors import NetworkError
from camera_node.protocol.server_connection import ServerConnection
from camera_node.protocol.session import open_client, open_router
from tests.conftest import free_port
from tests.waiting import Inbox, poll


class Network:
    """Routers and clients that are closed when the test ends."""

    def __init__(self) -> None:
        self._sessions: list[zenoh.Session | ServerConnection] = []
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
        """Open a session with the router."""
        return self._register(open_client([self.endpoint]))

    def connection(self) -> ServerConnection:
        """Begin to connect to the router, which may open later."""
        connection = ServerConnection([self.endpoint])
        self._sessions.append(connection)
        return connection

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
    return poll


@pytest.fixture
def inbox() -> Callable[[], Inbox]:
    return Inbox
