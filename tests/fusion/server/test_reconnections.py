# SPDX-License-Identifier: BSD-3-Clause
"""Sessions that come and go cost the server no memory for good."""

import ctypes
import gc
from pathlib import Path

import pytest

from camera_node.foundation.program import glibc
from camera_node.protocol.session import open_client
from fusion.server.server import Server
from tests.fusion.serving import KEYS, config, serving
from tests.waiting import poll

SESSIONS = 60
MAX_BYTES = 2000  # in use for each session that has ended; Zenoh 1.10 leaves 100 to 400
FIELDS = "arena ordblks smblks hblks hblkhd usmblks fsmblks uordblks fordblks keepcost"


class AllocatorStatistics(ctypes.Structure):
    """`struct mallinfo2` of glibc."""

    _fields_ = [(name, ctypes.c_size_t) for name in FIELDS.split()]


def bytes_in_use() -> int:
    """Allocated and not freed, by all threads."""
    gc.collect()
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
    """What the server has in use for a moment does not grow with their number."""
    per_session: list[float] = []
    with serving(config(tmp_path)) as (server, _):
        come_and_go(server, SESSIONS)
        before = bytes_in_use()

        def is_little() -> bool:
            come_and_go(server, SESSIONS)
            per_session.append((bytes_in_use() - before) / (SESSIONS * (len(per_session) + 1)))
            return per_session[-1] < MAX_BYTES

        assert poll(is_little, deadline_s=30.0), per_session
