# SPDX-License-Identifier: BSD-3-Clause
"""Prints the output of all programs: results on stdout, progress on stderr.

Lines are wrapped only on a terminal, so that output in a pipe does not depend on a width. Progress bars are imported
where one is shown: every program begins with this module.
"""

import sys
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import IO, TypeVar

from rich.console import Console

T = TypeVar("T")
UNLIMITED = 10_000  # columns, where the output is not a terminal


def console() -> Console:
    """A console on stdout."""
    return _console_on(sys.stdout)


def progress_console() -> Console:
    """A console on stderr, for progress bars and live displays; silent where stderr is not a terminal."""
    return _console_on(sys.stderr, quiet=not sys.stderr.isatty())


def say(text: str, on: Console | None = None) -> None:
    """Print one line unchanged: without markup and without wrapping."""
    (on or console()).print(text, highlight=False, soft_wrap=True, markup=False)


def track(steps: Iterable[T], description: str, total: float | None = None) -> Iterable[T]:
    """Yield the steps and show a progress bar, which disappears at the end."""
    from rich.progress import track as track_steps

    return track_steps(steps, description, total, console=progress_console(), transient=True)


@contextmanager
def progress_bar(description: str) -> Iterator[Callable[[float], None]]:
    """A progress bar that disappears at the end; yields a function that sets it to a share of the work, 0 to 1."""
    from rich.progress import Progress

    with Progress(console=progress_console(), transient=True) as progress:
        task = progress.add_task(description, total=1.0)
        yield lambda share: progress.update(task, completed=share)


def _console_on(stream: IO[str], quiet: bool = False) -> Console:
    return Console(file=stream, width=None if stream.isatty() else UNLIMITED, emoji=False, quiet=quiet)
