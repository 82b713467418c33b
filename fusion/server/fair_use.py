# SPDX-License-Identifier: BSD-3-Clause
"""No sender takes more than its share of the server.

Each camera has a quota of frames, decided on arrival, before anything is decoded (`FrameQuotas`). Each sender has a
bounded queue for the server's thread, and requests have a bounded share of that thread's time (`TaskQueue`) and of the
time of a thread that works ahead of it (`Preparation`).
"""

import contextlib
import logging
import math
import queue
import threading
import time
from collections import deque
from collections.abc import Callable, Collection
from dataclasses import dataclass

from camera_node.foundation.rate_limit import RateLimit

log = logging.getLogger("fusion")
REQUEST_SHARE = 0.2  # of the server's thread's time, for requests
WAITING = 16  # pieces of work to prepare; further ones are refused
POLL_S = 1.0
LONGEST_PAUSE_S = 5.0  # of the preparation
FRAMES_PER_SET = 4.0  # accepted from one camera, on average: more than the synchronizer's FAR_FASTER
SLACK = 16  # frames that may arrive at once in addition to those of the lateness limit
UNCALIBRATED_HZ = 2000.0  # messages a second of all cameras together that the rig does not contain
UNCALIBRATED = "cameras without a pose"


class FrameQuotas:
    """A quota for each camera of the rig, and one for all other cameras together.

    Args:
        lateness_ms: how long a frame set waits: frames of that time may arrive at once.
        rate_hz: of the frame sets.
    """

    def __init__(self, lateness_ms: float, rate_hz: float) -> None:
        self._lateness_s = lateness_ms * 1e-3
        self._rate_hz = rate_hz
        self._others = RateLimit(UNCALIBRATED_HZ, UNCALIBRATED_HZ)
        self._cameras: dict[str, RateLimit] = {}

    @property
    def limit_hz(self) -> float:
        """Frames a second that one camera may send."""
        return FRAMES_PER_SET * self._rate_hz

    @property
    def burst(self) -> int:
        """Frames of one camera that may arrive at once, and wait in the queue."""
        return math.ceil(self.limit_hz * self._lateness_s) + SLACK

    def update(self, keys: Collection[str], rate_hz: float) -> None:
        """Set the keys of the rig's cameras and the rate of the frame sets."""
        self._rate_hz = rate_hz
        quotas = {key: self._cameras.get(key) or RateLimit(self.limit_hz, self.burst) for key in keys}
        for quota in quotas.values():
            quota.rate_hz, quota.burst = self.limit_hz, self.burst
        self._cameras = quotas  # replaced as a whole: `admit` runs on Zenoh's threads

    def sender_of(self, key: str) -> str:
        """The sender of a frame on this key."""
        return key if key in self._cameras else UNCALIBRATED

    def admits(self, sender: str) -> bool:
        """Whether another frame of the sender is within its quota."""
        return self._cameras.get(sender, self._others).passes()


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


class Preparation:
    """A thread that works ahead of the server's: what a request needs and no state of the server, such as lens tables.

    It does one piece of work after the other, in at most the share of time that requests have.

    Python executes one thread at a time, so a flood of work would slow the server's thread down.
    """

    def __init__(self) -> None:
        # the work, and what follows it; None at the end
        self._waiting: queue.Queue[tuple[Callable[[], object], Callable[[], object]] | None] = queue.Queue(
            WAITING
        )
        self._closed = threading.Event()
        self._thread = threading.Thread(target=self._run, name="preparation", daemon=True)
        self._thread.start()

    def put(self, work: Callable[[], object], then: Callable[[], object]) -> bool:
        """Do some work, then call `then`, also if the work failed; False if too much work waits. Never blocks."""
        try:
            self._waiting.put_nowait((work, then))
        except queue.Full:
            return False
        return True

    def close(self) -> None:
        """End after the present work."""
        self._closed.set()
        with contextlib.suppress(queue.Full):  # then the thread is not waiting for work
            self._waiting.put_nowait(None)
        self._thread.join(LONGEST_PAUSE_S)

    def _run(self) -> None:
        while not self._closed.is_set():
            try:
                task = self._waiting.get(timeout=POLL_S)
            except queue.Empty:
                continue
            if task is None:
                break
            work, then = task
            begun_s = time.monotonic()
            try:
                work()
            except Exception:  # the server's thread meets the same fault, and answers with it
                log.exception("the preparation of a request failed")
            used_s = time.monotonic() - begun_s
            then()
            self._closed.wait(min(used_s * (1 / REQUEST_SHARE - 1), LONGEST_PAUSE_S))
