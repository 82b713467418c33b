# SPDX-License-Identifier: BSD-3-Clause
"""Programs in processes of their own. None outlasts its block, and none makes a test wait without a deadline."""

import select
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

from tests.conftest import ROOT
from tests.waiting import DEADLINE_S


@contextmanager
def running(module: str, *words: object, **options: Any) -> Iterator[subprocess.Popen]:
    """`python -m MODULE WORDS` until the block ends, then SIGTERM: it must end with exit code 0.

    Args:
        module: of the program.
        words: its arguments.
        options: of `subprocess.Popen`.
    """
    command = [sys.executable, "-m", module, *map(str, words)]
    with killed_at_end(command, **{"cwd": ROOT, **options}) as process:
        yield process
        process.terminate()
        assert process.wait(DEADLINE_S) == 0


def run_program(*words: object, timeout_s: float = DEADLINE_S) -> subprocess.CompletedProcess[str]:
    """Run `python -m PROGRAM ...` to its end in a fresh process, as a user does."""
    command = [sys.executable, "-m", *map(str, words)]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=timeout_s, check=False)


@contextmanager
def killed_at_end(command: Sequence[str], **options: Any) -> Iterator[subprocess.Popen]:
    """A command, which SIGKILL ends with the block."""
    with subprocess.Popen(command, **options) as process:
        try:
            yield process
        finally:
            process.kill()


def first_line(process: subprocess.Popen[str]) -> str:
    """The first line of a program's standard output, which must be a pipe."""
    assert process.stdout is not None
    ready, _, _ = select.select([process.stdout], [], [], DEADLINE_S)
    assert ready, "the program printed nothing in time"
    line = process.stdout.readline()
    assert line, "the program ended"
    return line
