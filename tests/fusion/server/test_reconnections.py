# SPDX-License-Identifier: BSD-3-Clause
"""Sessions that come and go cost the server no memory for good."""

import ctypes
from pathlib import Path

import pytest

from camera_node.processes.allocator import glibc
from camera_node.protocol.session import open_client
from fusion.server.server import Server
from tests.fusion.serving import KEYS, config, serving

SESSIONS = 60
MAX_BYTES = 2000  # in use for each session that has ended; Zenoh 1.10 leaves 100 to 400
FIELDS = "arena ordblks smblks hblks hblkhd usmblks fsmblks uordblks fordblks keepcost"


class AllocatorStatistics(ctypes.Structure):
    """`struct mallinfo2` of glibc."""

    _fields_ = [(name, ctypes.c_size_t) for name in FIELDS.split()]


def bytes_in_use() -> int:
    """Allocated and not freed, by all threads."""
    library = glibc()
    assert library is not None
    library.mallinfo2.restype = AllocatorStatistics
    statistics = library.mallinfo2()
    return statistics.uordblks + statistics.hblkhd


def come_and_go(server: Server, sessions: int) -> None:
    """Sessions like those of cameras and of viewers, one after the other."""
    for _ in range(sessions):
        with open_client(server.endpoints) as session:
            session.declare_subscriber(KEYS.poses, print)
            session.liveliness().declare_token(KEYS.camera_alive("cam0"))
            session.declare_publisher(KEYS.detections("cam0")).put(b"")
            assert list(session.get(KEYS.clock, timeout=5.0))


@pytest.mark.skipif(glibc() is None, reason="the allocator is not glibc's")
def test_a_session_that_has_ended_leaves_little_memory(tmp_path: Path):
    with serving(config(tmp_path)) as (server, _):
        come_and_go(server, SESSIONS)
        before = bytes_in_use()
        come_and_go(server, SESSIONS)
        assert bytes_in_use() - before < MAX_BYTES * SESSIONS
