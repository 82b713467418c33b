# SPDX-License-Identifier: BSD-3-Clause
"""Sockets of this process do not linger after they are closed."""

import socket
import struct

from camera_node.protocol.tcp_sockets import stop_lingering
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
