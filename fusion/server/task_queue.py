# SPDX-License-Identifier: BSD-3-Clause
"""The tasks of the server's thread: a bounded queue for each sender, and a bounded share of time for requests."""

import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

REQUEST_SHARE = 0.2  # of the thread's time, for requests


@dataclass(frozen=True, slots=True)
class Task:
    """Something to execute on the server's thread.

    Attributes:
        sender: whose it is; a key or a group of keys.
        received_ns: when it arrived.
        run: does it.
        drop: is called instead if it can't wait or waited too long.
        is_request: whether it is limited to `REQUEST_SHARE` of the thread's time.
    """

    sender: str
    received_ns: int
    run: Callable[[], object]
    drop: Callable[[], object]
    is_request: bool = False


class TaskQueue:
    """Yields tasks in the order of their arrival. Each sender has its own limit, so none displaces another's tasks.

    Requests wait while they have used up their share of the time. Callable from several threads.
    """

    def __init__(self) -> None:
        self._queues: dict[str, deque[Task]] = {}
        self._changed = threading.Condition()
        self._requests_due_s = 0.0

    def put(self, task: Task, limit: int) -> Task | None:
        """Add a task; returns the one without room if `limit` of its sender wait: a message displaces the oldest."""
        with self._changed:
            tasks = self._queues.setdefault(task.sender, deque())
            if len(tasks) >= limit and task.is_request:
                return task
            dropped = tasks.popleft() if len(tasks) >= limit else None
            tasks.append(task)
            self._changed.notify()
        return dropped

    def take(self, timeout_s: float) -> Task | None:
        """Remove and return the next task; None if there is none within `timeout_s`."""
        with self._changed:
            self._changed.wait_for(self._next, timeout_s)
            task = self._next()
            if task is not None:
                tasks = self._queues[task.sender]
                tasks.popleft()
                if not tasks:
                    del self._queues[task.sender]
        return task

    def has_messages(self) -> bool:
        """Whether a task that is no request waits."""
        with self._changed:
            return any(not tasks[0].is_request for tasks in self._queues.values())

    def charge_request(self, seconds: float) -> None:
        """Let requests wait until one of so many seconds is no more than their share of the time."""
        self._requests_due_s = time.monotonic() + seconds * (1 / REQUEST_SHARE - 1)

    def _next(self) -> Task | None:
        may_request = time.monotonic() >= self._requests_due_s
        heads = [tasks[0] for tasks in self._queues.values() if may_request or not tasks[0].is_request]
        return min(heads, key=lambda task: task.received_ns, default=None)
