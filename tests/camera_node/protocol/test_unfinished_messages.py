# SPDX-License-Identifier: BSD-3-Clause
"""Clients that never complete their messages: a router holds their parts, between processes."""

import contextlib
import socket
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import zenoh

from camera_node.protocol.session import open_client
from tests.processes import first_line, killed_at_end
from tests.waiting import DEADLINE_S, poll

N_SESSIONS = 8
MAX_GROWTH = 6e6  # bytes of the router for each session; before, 17e6
FRAGMENT, MORE, KIND = (
    0x06,
    0x40,
    0x1F,
)  # of the first byte of what Zenoh sends at once: a part, not the last one
ROUTER = """
import sys
from camera_node.protocol.session import listening_endpoints, open_router
listen = ["tcp/127.0.0.1:0"]
with open_router(listen) as router:
    print(*listening_endpoints(router, listen), flush=True)
    router.declare_queryable("a/alive", lambda query: query.reply("a/alive", b"yes"))
    sys.stdin.read()
"""


class Hostile:
    """Listens for clients, and forwards to a router all that they send but the last parts of their messages.

    Args:
        port: of the router.
        n: how many clients it accepts.
    """

    def __init__(self, port: int, n: int, stack: contextlib.ExitStack) -> None:
        self._port, self._stack = port, stack
        self._listener = stack.enter_context(socket.create_server(("127.0.0.1", 0)))
        self.endpoint = f"tcp/127.0.0.1:{self._listener.getsockname()[1]}"
        self._lock, self.n_withheld = threading.Lock(), 0
        self._start(lambda: [self._connect() for _ in range(n)])

    def _start(self, run: Callable[[], object]) -> None:
        threading.Thread(target=run, daemon=True).start()

    def _connect(self) -> None:
        client = self._stack.enter_context(self._listener.accept()[0])
        router = self._stack.enter_context(socket.create_connection(("127.0.0.1", self._port)))
        self._start(lambda: self._forward(client, router, is_hostile=True))
        self._start(lambda: self._forward(router, client, is_hostile=False))

    def _forward(self, source: socket.socket, target: socket.socket, is_hostile: bool) -> None:
        with contextlib.suppress(OSError), source.makefile("rb") as stream:
            while len(head := stream.read(2)) == 2:
                batch = stream.read(int.from_bytes(head, "little"))
                if is_hostile and batch[0] & KIND == FRAGMENT and not batch[0] & MORE:
                    with self._lock:
                        self.n_withheld += 1
                else:
                    target.sendall(head + batch)


def resident(process: subprocess.Popen) -> float:
    """Bytes of memory that a process has now."""
    status = Path(f"/proc/{process.pid}/status").read_text()
    return 1024 * int(status.split("VmRSS:")[1].split()[0])


@contextlib.contextmanager
def router_process() -> Iterator[tuple[subprocess.Popen, int]]:
    command = [sys.executable, "-c", ROUTER]
    with killed_at_end(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        yield process, int(first_line(process).rsplit(":", 1)[1])


@pytest.mark.parametrize("size", [1 << 22, (1 << 24) - 100_000])
def test_messages_that_are_never_completed_hold_little_memory(size: int):
    """A router still answers others, and its memory is bounded by a message of each session."""
    with router_process() as (process, port), contextlib.ExitStack() as stack:
        hostile, before = Hostile(port, N_SESSIONS, stack), resident(process)
        for k in range(N_SESSIONS):
            session = stack.enter_context(open_client([hostile.endpoint], timeout_s=DEADLINE_S))
            session.put("a/parts", bytes(size), congestion_control=zenoh.CongestionControl.BLOCK)
            assert poll(lambda n=k + 1: hostile.n_withheld >= n)
        with open_client([f"tcp/127.0.0.1:{port}"], timeout_s=DEADLINE_S) as other:
            assert any(reply.ok for reply in other.get("a/alive", timeout=DEADLINE_S))
        assert resident(process) - before < N_SESSIONS * MAX_GROWTH
