# SPDX-License-Identifier: BSD-3-Clause
"""The server's side of Zenoh: what arrives waits in a queue for the server's thread, what is told has a publisher."""

import contextlib
import queue
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import msgspec
import zenoh

from camera_node.errors import ConfigError
from camera_node.protocol.messages import encode
from camera_node.protocol.requests import respond
from camera_node.protocol.session import has_assigned_port, open_client, open_router
from fusion.protocol.shards import Shard
from fusion.server.config import ArenaConfig

QUEUE = 2000  # messages: seconds of a large arena
Task = Callable[[], object]


def open_session(config: ArenaConfig, shard: Shard) -> zenoh.Session:
    """The arena's router, or of another shard a connection to it.

    Raises:
        NetworkError: an endpoint is taken.
        ConfigError: another shard is to connect to port 0.
    """
    zenoh_config = Path(config.zenoh) if config.zenoh else None
    if shard.leads:
        return open_router(config.listen, zenoh_config)
    if has_assigned_port(config.listen):
        raise ConfigError(
            f"shard {config.shard} connects to {' '.join(config.listen)}; give the first shard's port in --listen"
        )
    return open_client([e.replace("0.0.0.0", "127.0.0.1") for e in config.listen], zenoh_config)


class Transport:
    """Of an open session.

    Args:
        session: Zenoh's.
        count: called, from any thread, with the name of a fault.
        closing: on which everything that is declared here is undeclared.
    """

    def __init__(
        self, session: zenoh.Session, count: Callable[[str], None], closing: contextlib.ExitStack
    ) -> None:
        self.session = session
        self._count, self._closing = count, closing
        self._tasks: queue.Queue[tuple[int, Task]] = queue.Queue(QUEUE)
        self.reached_ns = 0  # when the last task came that was done
        self._publishers: dict[str, zenoh.Publisher] = {}

    def subscribe(self, key: str, take: Callable[[bytes, str, int], None]) -> None:
        """Have the server's thread take what comes: its bytes, its key, and when it came (ns)."""

        def enqueue(sample: zenoh.Sample) -> None:  # whatever else it did would stall the link
            data, key = sample.payload.to_bytes(), str(sample.key_expr)
            self.put(lambda: take(data, key, self.reached_ns))

        self._closing.callback(self.session.declare_subscriber(key, enqueue).undeclare)

    def answer(self, key: str, reply: Callable[[zenoh.Query], None]) -> None:
        """Answer queries on Zenoh's thread: at once, hence with nothing that the server's thread changes."""
        self._closing.callback(self.session.declare_queryable(key, reply).undeclare)

    def answer_later(self, key: str, answer: Callable[[zenoh.Query], bytes]) -> None:
        """Answer queries on the server's thread; a RoundelError becomes the reply."""
        self.answer(key, lambda query: self.put(partial(respond, query, answer)))

    def show_alive(self, key: str) -> None:
        """A liveliness token."""
        self._closing.callback(self.session.liveliness().declare_token(key).undeclare)

    def put(self, task: Task) -> None:
        """Have the server's thread do something; callable from any thread."""
        try:
            self._tasks.put_nowait((time.time_ns(), task))
        except queue.Full:
            self._count("queue full")

    def work(self, timeout_s: float) -> bool:
        """Do the next task, waiting for one no longer than `timeout_s`; whether there is another."""
        with contextlib.suppress(queue.Empty):
            self.reached_ns, task = self._tasks.get(timeout=timeout_s)
            task()
        return not self._tasks.empty()

    def publish(self, key: str, message: msgspec.Struct) -> None:
        """Put a message on a key."""
        if key not in self._publishers:
            self._publishers[key] = self.session.declare_publisher(key)
        self._publishers[key].put(encode(message))

    def forget(self, key: str) -> None:
        """Nothing is published on a key any more."""
        if key in self._publishers:
            self._publishers.pop(key).undeclare()
