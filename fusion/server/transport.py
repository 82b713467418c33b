# SPDX-License-Identifier: BSD-3-Clause
"""The server's side of Zenoh: queues received messages for the server's thread, and publishes."""

import contextlib
import queue
from collections.abc import Callable
from functools import partial
from pathlib import Path

import msgspec
import zenoh

from camera_node.errors import ConfigError
from camera_node.node.clock_sync import ClockSync
from camera_node.protocol.messages import encode
from camera_node.protocol.requests import respond
from camera_node.protocol.session import has_assigned_port, open_client, open_router
from fusion.protocol.shards import Shard
from fusion.server.config import ArenaConfig
from fusion.server.server_clock import ServerClock

QUEUE_SIZE = 2000  # messages: seconds of a large arena
Task = Callable[[], object]


def open_session(config: ArenaConfig, shard: Shard) -> zenoh.Session:
    """Open the arena's router in the leading shard, a connection to it in any other.

    Raises:
        NetworkError: an endpoint is taken.
        ConfigError: a shard that does not lead would connect to port 0.
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
    """Subscribes, answers queries and publishes on an open session. Callbacks only enqueue tasks.

    Args:
        session: an open Zenoh session.
        clock: the server's time, of arrivals.
        count_fault: called with the name of a fault, from any thread.
        closing: undeclares everything that this object declares.
    """

    def __init__(
        self,
        session: zenoh.Session,
        clock: ServerClock | ClockSync,
        count_fault: Callable[[str], None],
        closing: contextlib.ExitStack,
    ) -> None:
        self.session = session
        self._clock, self._count_fault, self._closing = clock, count_fault, closing
        self._tasks: queue.Queue[tuple[int, Task]] = queue.Queue(QUEUE_SIZE)
        self.received_ns = 0  # arrival time of the last task that was executed
        self._publishers: dict[str, zenoh.Publisher] = {}

    def subscribe(self, key: str, handle: Callable[[bytes, str, int], None]) -> None:
        """Call `handle(data, key, received_ns)` for each message, on the server's thread."""

        def enqueue(sample: zenoh.Sample) -> None:  # anything else would stall the link
            data, key = sample.payload.to_bytes(), str(sample.key_expr)
            self.enqueue(lambda: handle(data, key, self.received_ns))

        self._closing.callback(self.session.declare_subscriber(key, enqueue).undeclare)

    def answer(self, key: str, reply: Callable[[zenoh.Query], None]) -> None:
        """Answer queries at once on Zenoh's thread: `reply` must not modify the server's state."""
        self._closing.callback(self.session.declare_queryable(key, reply).undeclare)

    def answer_on_server_thread(self, key: str, answer: Callable[[zenoh.Query], bytes]) -> None:
        """Answer queries on the server's thread; a RoundelError becomes the reply."""
        self.answer(key, lambda query: self.enqueue(partial(respond, query, answer)))

    def watch_token(self, key: str, handle: Callable[[bool], object]) -> None:
        """Call `handle` on the server's thread with whether the liveliness token is there, now and on each change."""

        def enqueue(sample: zenoh.Sample) -> None:
            is_alive = sample.kind == zenoh.SampleKind.PUT
            self.enqueue(lambda: handle(is_alive))

        subscriber = self.session.liveliness().declare_subscriber(key, enqueue, history=True)
        self._closing.callback(subscriber.undeclare)

    def declare_alive(self, key: str) -> None:
        """Declare a liveliness token."""
        self._closing.callback(self.session.liveliness().declare_token(key).undeclare)

    def enqueue(self, task: Task) -> None:
        """Execute a task on the server's thread; callable from any thread."""
        try:
            self._tasks.put_nowait((self._clock.now_ns(), task))
        except queue.Full:
            self._count_fault("queue full")

    def receive(self, timeout_s: float) -> bool:
        """Execute the next task, waiting for it at most `timeout_s`; return whether more tasks are queued."""
        with contextlib.suppress(queue.Empty):
            self.received_ns, task = self._tasks.get(timeout=timeout_s)
            task()
        return not self._tasks.empty()

    def publish(self, key: str, message: msgspec.Struct) -> None:
        """Put a message on a key."""
        if key not in self._publishers:
            self._publishers[key] = self.session.declare_publisher(key)
        self._publishers[key].put(encode(message))

    def undeclare(self, key: str) -> None:
        """Undeclare the publisher of a key that is no longer used."""
        if key in self._publishers:
            self._publishers.pop(key).undeclare()
