# SPDX-License-Identifier: BSD-3-Clause
"""The server's side of Zenoh: queues received messages for the server's thread, and publishes."""

import contextlib
import logging
import time
from collections.abc import Callable, Collection
from functools import partial
from pathlib import Path
from typing import TypeVar

import msgspec
import zenoh

from camera_node.foundation.rate_limit import RateLimit
from camera_node.node.clock_sync import ClockSync
from camera_node.protocol.messages import encode
from camera_node.protocol.requests import REQUEST_S, payload_of, respond
from camera_node.protocol.session import guarded, open_router
from fusion.server.arena_config import ArenaConfig
from fusion.server.fair_use import FrameQuotas, Preparation, Task, TaskQueue
from fusion.server.server_clock import ServerClock

log = logging.getLogger("fusion")
MESSAGES = 256  # queued, of one key that is not a camera's
REQUESTS = 16  # queued, of one key
ABOVE_QUOTA = "frames above the quota"
TOO_SLOW = "messages that the server was too slow for"
INTERNAL_ERROR = "internal error"
MessageHandler = Callable[[bytes, str, int], None]
Prepare = Callable[[bytes], object]
T = TypeVar("T")


def open_session(config: ArenaConfig) -> zenoh.Session:
    """Open the arena's router; that of a zone connects to those of the zones before it, and retries for ever.

    Raises:
        NetworkError: an endpoint is taken.
    """
    names = [zone.name for zone in config.zones]
    before = config.zones[: names.index(config.zone)] if config.zone else ()
    zenoh_config = Path(config.zenoh) if config.zenoh else None
    return open_router(config.listen, zenoh_config, [zone.server for zone in before])


class Transport:
    """Subscribes, answers queries and publishes on an open session. Callbacks only enqueue tasks, and never raise.

    Args:
        session: an open Zenoh session.
        clock: the server's time, of arrivals.
        count_fault: called with the name of a fault, and with the key of its sender, from any thread.
        closing: undeclares everything that this object declares.
    """

    def __init__(
        self,
        session: zenoh.Session,
        clock: ServerClock | ClockSync,
        count_fault: Callable[[str, str], None],
        closing: contextlib.ExitStack,
    ) -> None:
        self.session = session
        self._clock, self._count_fault, self._closing = clock, count_fault, closing
        self._tasks = TaskQueue()
        self._preparation = Preparation()
        closing.callback(self._preparation.close)
        self.received_ns = 0  # arrival time of the last message that was handled
        self._publishers: dict[str, zenoh.Publisher] = {}
        self._frames: dict[str, zenoh.Subscriber] = {}  # subscribers of `subscribe_frames`
        closing.callback(self._end_frames)

    def subscribe(self, key: str, handle: MessageHandler, prepare: Prepare | None = None) -> None:
        """Call `handle(data, key, received_ns)` for each message, on the server's thread.

        Args:
            key: of the messages.
            handle: uses a message.
            prepare: is called first, with the message, on a thread for work ahead.
        """

        def enqueue(sample: zenoh.Sample) -> None:
            data, sender = sample.payload.to_bytes(), str(sample.key_expr)
            self._after(prepare, sender, data, partial(self._enqueue, sender, data, handle, key, MESSAGES))

        self._declare_subscriber(key, enqueue)

    def subscribe_frames(self, keys: Collection[str], handle: MessageHandler, quotas: FrameQuotas) -> None:
        """The same for the frames of cameras on these keys and no others, each within its quota."""

        def enqueue(sample: zenoh.Sample) -> None:
            key = str(sample.key_expr)
            sender = quotas.sender_of(key)
            if quotas.admits(sender):
                self._enqueue(key, sample.payload.to_bytes(), handle, sender, quotas.burst)
            else:
                self._count_fault(ABOVE_QUOTA, key)

        for key in self._frames.keys() - set(keys):
            self._frames.pop(key).undeclare()
        for key in set(keys) - self._frames.keys():
            self._frames[key] = self.session.declare_subscriber(key, self._guarded(key, enqueue))

    def request(self, key: str, handle: MessageHandler, prepare: Prepare | None = None) -> None:
        """Query a key; call `handle(data, key, received_ns)` for each reply, on the server's thread.

        `prepare` as in `subscribe`.
        """

        def enqueue(reply: zenoh.Reply) -> None:
            if reply.ok is not None:
                key, data = str(reply.ok.key_expr), reply.ok.payload.to_bytes()
                self._after(prepare, key, data, partial(self._enqueue, key, data, handle, key, MESSAGES))

        self.session.get(key, self._guarded(key, enqueue), timeout=REQUEST_S)

    def answer(
        self, key: str, reply: Callable[[zenoh.Query], object], limit: RateLimit | None = None
    ) -> None:
        """Answer queries at once on Zenoh's thread: `reply` must not modify the server's state."""

        def take(query: zenoh.Query) -> None:
            if limit is None or limit.passes():
                reply(query)
            else:
                self._refuse(query)

        queryable = self.session.declare_queryable(key, self._guarded(key, take))
        self._closing.callback(queryable.undeclare)

    def answer_on_server_thread(
        self, key: str, answer: Callable[[zenoh.Query], bytes], prepare: Prepare | None = None
    ) -> None:
        """Answer queries on the server's thread; a RoundelError becomes the reply. `prepare` as in `subscribe`."""

        def enqueue(query: zenoh.Query) -> None:
            run, drop = partial(respond, query, answer), partial(self._refuse, query)
            self._put(Task(key, self._clock.now_ns(), run, drop, is_request=True), REQUESTS)

        def take(query: zenoh.Query) -> None:
            if prepare is None:
                enqueue(query)
            elif not self._preparation.put(partial(prepare, payload_of(query)), partial(enqueue, query)):
                self._refuse(query)

        self.answer(key, take)

    def watch_tokens(self, key: str, handle: Callable[[str, bool], object]) -> None:
        """Call `handle(key, is_alive)` on the server's thread for each liveliness token, now and on each change."""

        def enqueue(sample: zenoh.Sample) -> None:
            token, is_alive = str(sample.key_expr), sample.kind == zenoh.SampleKind.PUT
            self.enqueue(lambda: handle(token, is_alive))

        subscriber = self.session.liveliness().declare_subscriber(key, enqueue, history=True)
        self._closing.callback(subscriber.undeclare)

    def declare_alive(self, key: str) -> None:
        """Declare a liveliness token."""
        self._closing.callback(self.session.liveliness().declare_token(key).undeclare)

    def enqueue(self, run: Callable[[], object]) -> None:
        """Execute something on the server's thread; callable from any thread."""
        self._put(Task("the server", self._clock.now_ns(), run, run), MESSAGES)

    def receive(self, timeout_s: float, max_wait_ns: int) -> bool:
        """Execute the next task, waiting for it at most `timeout_s`. No exception of a task leaves this method.

        Args:
            timeout_s: of waiting.
            max_wait_ns: messages that were queued for longer are dropped.

        Returns:
            whether more messages are queued.
        """
        task = self._tasks.take(timeout_s)
        if task is None:
            return False
        begun_s = time.monotonic()
        try:
            if task.is_request:
                task.run()
            else:
                self.received_ns = task.received_ns
                is_stale = self._clock.now_ns() - task.received_ns > max_wait_ns
                (task.drop if is_stale else task.run)()
        except Exception:  # of a bug that some input shows: the next task is another's
            self._count_fault(INTERNAL_ERROR, task.sender)
            log.exception("a task of %s failed; the server continues without it", task.sender)
        if task.is_request:
            self._tasks.charge_request(time.monotonic() - begun_s)
        return self._tasks.has_messages()

    def _end_frames(self) -> None:
        for subscriber in self._frames.values():
            subscriber.undeclare()

    def _declare_subscriber(self, key: str, enqueue: Callable[[zenoh.Sample], object]) -> None:
        subscriber = self.session.declare_subscriber(key, self._guarded(key, enqueue))
        self._closing.callback(subscriber.undeclare)

    def _guarded(self, key: str, callback: Callable[[T], object]) -> Callable[[T], None]:
        return guarded(f"a message on {key}", callback, partial(self._count_fault, INTERNAL_ERROR, key))

    def _after(self, prepare: Prepare | None, key: str, data: bytes, enqueue: Callable[[], object]) -> None:
        """Call `enqueue` after the preparation, or at once without one."""
        if prepare is None:
            enqueue()
        elif not self._preparation.put(partial(prepare, data), enqueue):
            self._count_fault(TOO_SLOW, key)

    def _enqueue(self, key: str, data: bytes, handle: MessageHandler, sender: str, limit: int) -> None:
        received_ns = self._clock.now_ns()
        run, drop = partial(handle, data, key, received_ns), partial(self._count_fault, TOO_SLOW, key)
        self._put(Task(sender, received_ns, run, drop), limit)

    def _put(self, task: Task, limit: int) -> None:
        dropped = self._tasks.put(task, limit)
        if dropped is not None:
            dropped.drop()

    def _refuse(self, query: zenoh.Query) -> None:
        self._count_fault("requests that were too many", str(query.key_expr))
        with query:
            query.reply_err("the server has too many requests; try again later")

    def publish(self, key: str, message: msgspec.Struct) -> None:
        """Put a message on a key."""
        self.put(key, encode(message))

    def put(self, key: str, data: bytes) -> None:
        """Put an encoded message on a key."""
        if key not in self._publishers:
            self._publishers[key] = self.session.declare_publisher(key)
        self._publishers[key].put(data)

    def undeclare(self, key: str) -> None:
        """Undeclare the publisher of a key that is no longer used."""
        if key in self._publishers:
            self._publishers.pop(key).undeclare()
