# SPDX-License-Identifier: BSD-3-Clause
"""Streams of messages: iterate, get the latest, register a callback, or use `async for`.

A reader that is slower than the messages gets the newest one and skips the others.
"""

import asyncio
import contextlib
import difflib
import threading
from collections.abc import AsyncIterator, Callable, Collection, Iterator
from typing import Generic, TypeVar

import zenoh

from camera_node.foundation.config import is_name
from camera_node.foundation.errors import NetworkError
from camera_node.protocol.messages import RelativePositions
from camera_node.protocol.server_connection import ALIVE, ServerConnection
from camera_node.protocol.session import guarded
from fusion.protocol.pose_messages import RobotPose
from fusion.protocol.robot_requests import request_robots

T = TypeVar("T")
ANSWER_S = 1.0  # longest wait for each answer
MAX_NAMED = 20  # robots or arenas in one line
NO_SERVER = "is roundel server running there?"


class Stream(Generic[T]):
    """Messages of one kind, such as the poses of one robot.

    Iterating blocks until the next message, at most `timeout_s` (None: for ever), and ends when the arena is closed.

    Args:
        content: the word for the messages in errors.
        timeout_s: of iterating.

    Raises, while iterating:
        NetworkError: none arrived within `timeout_s`.
    """

    def __init__(self, content: str, timeout_s: float | None) -> None:
        self.timeout_s = timeout_s
        self._content = content
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

    def _cause(self) -> str:
        """The likely cause of silence, with what to do."""
        return NO_SERVER

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
    """The poses of one robot.

    Args:
        name: the robot's.
        origin: where its poses come from, for errors.
        timeout_s: of iterating.
        known: the names of all robots whose poses arrive; they grow.
    """

    def __init__(self, name: str, origin: str, timeout_s: float | None, known: Collection[str]) -> None:
        super().__init__(f"pose of '{name}' {origin}", timeout_s)
        self._name, self._known = name, known

    def _cause(self) -> str:
        known = sorted(self._known)
        if not known or self._name in known:
            return super()._cause()
        return no_such_robot(self._name, known)

    def on_pose(self, callback: Callable[[RobotPose], object]) -> Callable[[], None]:
        """Call `callback` with every pose, on Zenoh's thread: it must be fast. Returns its removal."""
        return self.on_message(callback)


class RelativeStream(Stream[RelativePositions]):
    """What one camera locates by itself."""

    def _cause(self) -> str:
        return "does roundel camera --rig RIG --diameter METRES run there under this name?"


def cause_of_silence(connection: ServerConnection, arena: str, robot: str | None = None) -> str:
    """The likely cause, with what to do; asks the server, and takes `ANSWER_S` for each of two questions at most.

    Args:
        connection: to the server.
        arena: from which poses are expected.
        robot: of which they are expected; None for all.
    """
    try:
        session = connection.session(0.0)
        if arena not in (present := _arenas(session)):
            return _other_arenas(present) if present else NO_SERVER
        known = sorted(request_robots(session, arena, ANSWER_S).robots)
    except (NetworkError, zenoh.ZError):
        return NO_SERVER
    if robot is not None and robot not in known:
        return no_such_robot(robot, known)
    return f"the server runs, and its robots are {_listed(known)}; do its cameras run?"


def no_such_robot(name: str, known: Collection[str]) -> str:
    """That an arena has other robots, and the one that was probably meant."""
    similar = difflib.get_close_matches(name, known, 1)
    hint = f"; did you mean {similar[0]}?" if similar else ""
    return f"the arena has no such robot, but {_listed(known)}{hint}"


def _arenas(session: zenoh.Session) -> list[str]:
    """The arenas whose servers this one reaches."""
    replies = session.liveliness().get(ALIVE, timeout=ANSWER_S)
    names = {str(reply.ok.key_expr).partition("/")[0] for reply in replies if reply.ok is not None}
    return sorted(name for name in names if is_name(name))


def _other_arenas(present: list[str]) -> str:
    option = f"give --arena {present[0]}" if len(present) == 1 else "choose one with --arena"
    return f"the arena there is {_listed(present)}: {option}"


def _listed(names: Collection[str]) -> str:
    return ", ".join(sorted(names)[:MAX_NAMED]) or "none"
