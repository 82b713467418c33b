# SPDX-License-Identifier: BSD-3-Clause
"""Sockets of this process do not linger after they are closed."""

import contextlib
import socket
import struct

import pytest

from camera_node.protocol.tcp_sockets import close_excess, stop_lingering
from tests.waiting import DEADLINE_S

ON = struct.pack("ii", 1, 10)  # as Zenoh sets it


def test_tcp_sockets_linger_no_more_and_stay_open(network):
    """Those of Zenoh on both ends of a connection, and others; a second call finds none."""
    router, client = network.router(), network.client()
    ours, other = socket.socket(), socket.socketpair()
    with ours, other[0], other[1]:
        ours.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, ON)
        assert stop_lingering() >= 3
        assert ours.getsockopt(socket.SOL_SOCKET, socket.SO_LINGER) == 0
        assert stop_lingering() == 0
        other[0].sendall(b"x")
        assert other[1].recv(1) == b"x"
    queryable = router.declare_queryable("a/b", lambda query: query.reply("a/b", b"here"))
    assert any(reply.ok for reply in client.get("a/b", timeout=DEADLINE_S))
    queryable.undeclare()


def test_the_newest_connections_of_an_address_beyond_the_limit_are_ended():
    """Connections from other addresses stay, and so do those that this process opened itself."""
    with contextlib.ExitStack() as stack:
        listener = stack.enter_context(socket.create_server(("127.0.0.1", 0)))
        kept, ended, other = [], [], []
        for host, clients, n in (("127.0.0.1", kept, 3), ("127.0.0.2", other, 3), ("127.0.0.1", ended, 2)):
            for _ in range(n):
                source = (host, 0)
                client = socket.create_connection(listener.getsockname(), DEADLINE_S, source)
                clients.append(stack.enter_context(client))
                stack.enter_context(listener.accept()[0])
        assert close_excess(3) == {"127.0.0.1": 2}
        for client in ended:
            assert client.recv(1) == b""
        for client in (*kept, *other):
            client.setblocking(False)
            with pytest.raises(BlockingIOError):
                client.recv(1)
