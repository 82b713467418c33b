# SPDX-License-Identifier: BSD-3-Clause
"""Streams of messages: iterate, get the latest, register a callback, or use `async for`.

A reader that is slower than the messages gets the newest one and skips the others.
"""

import asyncio
import contextlib
import threading
from collections.abc import AsyncIterator, Callable, Iterator
from typing import Generic, TypeVar

from camera_node.foundation.errors import NetworkError
from camera_node.protocol.session import guarded
from fusion.protocol.pose_messages import RobotPose

T = TypeVar("T")


class Stream(Generic[T]):
    """Messages of one kind, such as the poses of one robot.

    Iterating blocks until the next message, at most `timeout_s` (None: for ever), and ends when the arena is closed.

    Args:
        content: the word for the messages in errors.
        timeout_s: of iterating.
        cause: says at once why none arrives, and what to do.

    Raises, while iterating:
        NetworkError: none arrived within `timeout_s`.
    """

    def __init__(self, content: str, timeout_s: float | None, cause: Callable[[], str]) -> None:
        self.timeout_s = timeout_s
        self._content, self._cause = content, cause
        self._changed = threading.Condition()
        self._latest: T | None = None
        self._count = 0
        self._closed = False
        self._callbacks: list[Callable[[T], object]] = []

    def latest(self) -> T | None:
        """The newest message, or None before the first."""
        return self._latest

    def next(self, timeout_s: float | None = None) -> T:
        """Block until a message arrives after this call; the stream's own timeout applies unless one is given."""
        for message in self._follow(self.timeout_s if timeout_s is None else timeout_s):
            return message
        raise NetworkError(f"the arena was closed while waiting for {self._content}")

    def on_message(self, callback: Callable[[T], object]) -> Callable[[], None]:
        """Call `callback` with every message, on Zenoh's thread: it must be fast. Returns its removal.

        An exception of the callback is logged; the other callbacks and later messages are not affected.
        """
        call = guarded(f"a callback for {self._content}", callback)
        self._callbacks.append(call)

        def remove() -> None:
            with contextlib.suppress(ValueError):
                self._callbacks.remove(call)

        return remove

    def __iter__(self) -> Iterator[T]:
        return self._follow(self.timeout_s)

    async def __aiter__(self) -> AsyncIterator[T]:
        loop, arrived = asyncio.get_running_loop(), asyncio.Event()

        def wake(_: T) -> None:
            with contextlib.suppress(RuntimeError):  # the loop is closed
                loop.call_soon_threadsafe(arrived.set)

        remove = self.on_message(wake)
        try:
            while not self._closed:
                try:
                    await asyncio.wait_for(arrived.wait(), self.timeout_s)
                except TimeoutError:
                    raise self._silence(self.timeout_s) from None
                arrived.clear()
                if self._latest is not None:
                    yield self._latest
        finally:
            remove()

    def _follow(self, timeout_s: float | None) -> Iterator[T]:
        with self._changed:
            seen = self._count
        while True:
            with self._changed:
                has_changed = self._changed.wait_for(lambda: self._closed or self._count > seen, timeout_s)  # noqa: B023
                if self._closed:
                    return
                if not has_changed:
                    raise self._silence(timeout_s)
                seen, message = self._count, self._latest
            if message is not None:
                yield message

    def _silence(self, timeout_s: float | None) -> NetworkError:
        return NetworkError(f"no {self._content} within {timeout_s:g} s; {self._cause()}")

    def _put(self, message: T) -> None:
        with self._changed:
            self._latest = message
            self._count += 1
            self._changed.notify_all()
        for callback in tuple(self._callbacks):
            callback(message)

    def _close(self) -> None:
        with self._changed:
            self._closed = True
            self._changed.notify_all()


class RobotStream(Stream[RobotPose]):
    """The poses of one robot."""

    def on_pose(self, callback: Callable[[RobotPose], object]) -> Callable[[], None]:
        """Call `callback` with every pose, on Zenoh's thread: it must be fast. Returns its removal."""
        return self.on_message(callback)
