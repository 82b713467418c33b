# SPDX-License-Identifier: BSD-3-Clause
"""Streams of messages: iterate, get the latest, register a callback, or use `async for`.

A reader that is slower than the messages gets the newest one and skips the others.
"""

import contextlib
import math
import threading
import time
from collections.abc import AsyncIterator, Callable, Iterator
from typing import Generic, TypeVar

from camera_node.foundation.errors import NetworkError
from camera_node.protocol.session import guarded
from fusion.protocol.pose_messages import RobotPose

T = TypeVar("T")


def since_arrival(message: object, received_s: float) -> float:
    """The age in seconds of a message without a time of the server's: the time since it arrived."""
    return time.monotonic() - received_s


class Stream(Generic[T]):
    """Messages of one kind, such as the poses of one robot.

    Iterating blocks until the next message, at most `timeout_s` (None: for ever), and ends when the arena is closed.

    Args:
        content: the word for the messages in errors.
        timeout_s: of iterating.
        cause: says at once why none arrives, and what to do.
        age: of a message, seconds, by the message and its arrival (`time.monotonic`).

    Raises, while iterating:
        NetworkError: none arrived within `timeout_s`.
    """

    def __init__(
        self,
        content: str,
        timeout_s: float | None,
        cause: Callable[[], str],
        age: Callable[[T, float], float] = since_arrival,
    ) -> None:
        self.timeout_s = timeout_s
        self._content, self._cause, self._age = content, cause, age
        self._changed = threading.Condition()
        self._newest: tuple[T, float] | None = None  # and when it arrived
        self._count = 0
        self._closed = False
        self._callbacks: list[Callable[[T], object]] = []

    def latest(self, max_age_s: float | None = None) -> T | None:
        """The newest message, or None before the first; with `max_age_s`, None also if `age_s` is more."""
        newest = self._newest
        if newest is None or (max_age_s is not None and not self._age(*newest) <= max_age_s):
            return None
        return newest[0]

    def age_s(self) -> float:
        """The age of the newest message, seconds; infinite before the first. It grows while the server is away.

        The age counts from the time of which the message speaks, for a pose the middle of the exposure, by the
        server's clock, and contains the error bound of that clock. It is never less than the time since the arrival.
        """
        newest = self._newest
        return math.inf if newest is None else self._age(*newest)

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
        import asyncio  # a tenth of the start of a program that does not need it

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
                if self._newest is not None:
                    yield self._newest[0]
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
                seen, newest = self._count, self._newest
            if newest is not None:
                yield newest[0]

    def _silence(self, timeout_s: float | None) -> NetworkError:
        return NetworkError(f"no {self._content} within {timeout_s:g} s; {self._cause()}")

    def _put(self, message: T, received_s: float | None = None) -> None:
        """Take a message; `received_s` is when it arrived, now unless given."""
        with self._changed:
            self._newest = message, time.monotonic() if received_s is None else received_s
            self._count += 1
            self._changed.notify_all()
        for callback in tuple(self._callbacks):
            callback(message)

    def _close(self) -> None:
        with self._changed:
            self._closed = True
            self._changed.notify_all()


class RobotStream(Stream[RobotPose]):
    """The poses of one robot.

    Args:
        content, timeout_s, cause, age: see `Stream`.
        now_ns: the server's present time; None before it is known.
    """

    def __init__(
        self,
        content: str,
        timeout_s: float | None,
        cause: Callable[[], str],
        age: Callable[[RobotPose, float], float],
        now_ns: Callable[[], int | None],
    ) -> None:
        super().__init__(content, timeout_s, cause, age)
        self._now_ns = now_ns
        self._located: tuple[RobotPose, float] | None = None  # the newest pose that is not of a lost robot

    def latest(self, max_age_s: float | None = None) -> RobotPose | None:
        """The newest pose, or None before the first; with `max_age_s`, None also if it is older or the robot lost.

        Without `max_age_s`, the last pose is returned for as long as the server is away, and its state remains.
        """
        pose = super().latest(max_age_s)
        return None if pose is not None and max_age_s is not None and pose.state == "lost" else pose

    def now(self, max_age_s: float) -> RobotPose | None:
        """The newest pose, predicted for the present with its grown covariance (`RobotPose.at`).

        None if that pose is older than `max_age_s`, if the robot is lost, and before the server's time is known.

        Raises:
            ValueError: the server is of a version before 0.1 and does not say how robots move.
        """
        pose, now_ns = self.latest(max_age_s), self._now_ns()
        return None if pose is None or now_ns is None else pose.at(now_ns)

    def age_s(self) -> float:
        """As of `Stream`; while the robot is lost, the age of the last pose before it was lost."""
        located = self._located
        return math.inf if located is None else self._age(*located)

    def _put(self, message: RobotPose, received_s: float | None = None) -> None:
        received_s = time.monotonic() if received_s is None else received_s
        if message.state != "lost":
            self._located = message, received_s
        super()._put(message, received_s)

    def on_pose(self, callback: Callable[[RobotPose], object]) -> Callable[[], None]:
        """Call `callback` with every pose, on Zenoh's thread: it must be fast. Returns its removal."""
        return self.on_message(callback)
