# SPDX-License-Identifier: BSD-3-Clause
"""A thread that works ahead of the server's: what a request needs and no state of the server, such as lens tables."""

import contextlib
import logging
import queue
import threading
import time
from collections.abc import Callable

from fusion.server.task_queue import REQUEST_SHARE

log = logging.getLogger("fusion")
WAITING = 16  # pieces of work; further ones are refused
POLL_S = 1.0
LONGEST_PAUSE_S = 5.0
Task = tuple[Callable[[], object], Callable[[], object]]  # the work, and what follows it


class Preparation:
    """Does one piece of work after the other, in at most the share of time that requests have.

    Python executes one thread at a time, so a flood of work would slow the server's thread down.
    """

    def __init__(self) -> None:
        self._waiting: queue.Queue[Task | None] = queue.Queue(WAITING)
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
