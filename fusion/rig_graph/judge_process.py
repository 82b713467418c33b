# SPDX-License-Identifier: BSD-3-Clause
"""Where the cameras are judged: in a process of its own, in the calling thread, or when a recorded server did it."""

import os
import signal
import threading
from collections.abc import Callable
from concurrent.futures import BrokenExecutor, Executor, Future, ProcessPoolExecutor
from functools import partial
from multiprocessing import get_context, parent_process
from typing import Any, ParamSpec, TypeVar

P = ParamSpec("P")
T = TypeVar("T")
NICENESS = 10  # of the process that judges: poses and detections come first


class JudgeProcess(Executor):
    """One process that judges: a thread would delay the poses, since it shares their GIL. It begins with
    the first job, again after it crashed, and ends with this process, even by SIGKILL."""

    def __init__(self) -> None:
        self._pool = _pool()

    def submit(self, fn: Callable[..., T], /, *args: Any, **kwargs: Any) -> Future[T]:
        """Run a function of a module with arguments that can be pickled."""
        try:
            return self._pool.submit(fn, *args, **kwargs)
        except BrokenExecutor:
            self._pool = _pool()
            return self._pool.submit(fn, *args, **kwargs)

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """End the process."""
        self._pool.shutdown(wait=wait, cancel_futures=cancel_futures)


class RecordedJudgements(Executor):
    """Runs a judgement when a recorded server took it: that depends on how busy its machine was."""

    def __init__(self) -> None:
        self._allowed = 0
        self._release: Callable[[], None] | None = None  # the judgement that waits

    def submit(self, job: Callable[P, T], /, *args: P.args, **kwargs: P.kwargs) -> "Future[T]":
        """A future that `allow` makes done."""
        future: Future[T] = Future()
        self._release = partial(_run, future, partial(job, *args, **kwargs))
        self.allow(self._allowed)
        return future

    def allow(self, n: int) -> None:
        """From now on `n` judgements may be taken."""
        self._allowed = n
        if n > 0 and self._release is not None:
            release, self._release = self._release, None
            self._allowed -= 1
            release()


def done(job: Callable[[], T]) -> "Future[T]":
    """The result of a job that runs at once."""
    future: Future[T] = Future()
    _run(future, job)
    return future


def _run(future: "Future[T]", job: Callable[[], T]) -> None:
    try:
        future.set_result(job())
    except Exception as error:  # as of a job elsewhere
        future.set_exception(error)


def _pool() -> ProcessPoolExecutor:
    return ProcessPoolExecutor(1, get_context("spawn"), initializer=_begin)


def _begin() -> None:
    """Leave interrupts to the parent, and end with it."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    os.nice(NICENESS)
    threading.Thread(target=_end_with_parent, name="parent", daemon=True).start()


def _end_with_parent() -> None:
    parent = parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)
