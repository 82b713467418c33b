# SPDX-License-Identifier: BSD-3-Clause
"""Children whose end is a failure, and signals that end a program by an exception."""

import signal
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType

from camera_node.foundation.errors import TEMPORARY_FAILURE, USER_ERROR
from web.errors import WebError

TAIL_LINES = 8  # of a log, that the message of a failure quotes


class ProgramFailed(Exception):
    """A child stopped unexpectedly; the message quotes the end of its log."""


def raise_failure(name: str, code: int, log: Path) -> None:
    """Raise the error that describes how a child ended.

    Raises:
        WebError: with one line on a fault that the user can correct.
        ProgramFailed: otherwise.
    """
    lines = log.read_text(errors="replace").strip().splitlines()
    if code in (USER_ERROR, TEMPORARY_FAILURE) and lines and lines[-1].startswith("error: "):
        raise WebError(f"{name}: {lines[-1].removeprefix('error: ')}")
    raise ProgramFailed(f"{name} stopped with code {code}; {quote_end(log)}")


def quote_end(log: Path) -> str:
    """Name a log, and quote its last lines if it has any."""
    lines = log.read_text(errors="replace").strip().splitlines()
    return "\n".join([f"its log is {log}", *(f"  {line}" for line in lines[-TAIL_LINES:])])


@contextmanager
def interrupt_on_signals() -> Iterator[None]:
    """Raise KeyboardInterrupt on SIGINT, SIGTERM and SIGHUP, so that `with` blocks clean up."""

    def interrupt(number: int, frame: FrameType | None) -> None:
        raise KeyboardInterrupt

    numbers = [signal.SIGINT, signal.SIGTERM, signal.SIGHUP]
    before = [signal.signal(number, interrupt) for number in numbers]
    try:
        yield
    finally:
        for number, handler in zip(numbers, before, strict=True):
            signal.signal(number, handler)
