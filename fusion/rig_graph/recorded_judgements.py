# SPDX-License-Identifier: BSD-3-Clause
"""Judgements of cameras in the calling thread: at once, or when a recorded server took them."""

from collections.abc import Callable
from concurrent.futures import Executor, Future
from functools import partial
from typing import ParamSpec, TypeVar

P = ParamSpec("P")
T = TypeVar("T")


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


def start(job: Callable[[], T], executor: Executor | None) -> "Future[T]":
    """Run a job beside the calling thread, or at once in it with None."""
    return done(job) if executor is None else executor.submit(job)


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
