# SPDX-License-Identifier: BSD-3-Clause
"""An executor whose results come later, as of a process on a busy machine, by a clock that a test advances."""

from collections.abc import Callable
from concurrent.futures import Executor, Future
from functools import partial
from typing import Any

from fusion.rig_graph.judgements import watch

WATCHING = 0.1  # time of `watch` over that of a judgement


class LateResults(Executor):
    """Computes a result when it is due.

    Args:
        delay: from the call for a judgement to its result, in units of the clock.
        now: the clock.
    """

    def __init__(self, delay: float, now: Callable[[], float]) -> None:
        self._delay, self._now = delay, now
        self._waiting: list[tuple[float, Future[Any], Callable[[], Any]]] = []

    def submit(self, fn, /, *args, **kwargs) -> Future[Any]:
        delay = self._delay * (WATCHING if getattr(fn, "func", None) is watch else 1.0)
        self._waiting.append((self._now() + delay, Future(), partial(fn, *args, **kwargs)))
        return self._waiting[-1][1]

    def release(self) -> None:
        """Give the results that are due."""
        now = self._now()
        due = [entry for entry in self._waiting if entry[0] <= now]
        self._waiting = [entry for entry in self._waiting if entry[0] > now]
        for _, future, run in due:
            future.set_result(run())
