# SPDX-License-Identifier: BSD-3-Clause
"""Programs in processes of their own, of which none outlasts its block or makes a test wait without a deadline; and
commands in this process."""

import io
import select
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import chdir, contextmanager, redirect_stderr, redirect_stdout
from importlib import import_module
from pathlib import Path
from typing import Any

from camera_node.foundation.program import exit_code
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


def run_program(program: str, *words: object) -> subprocess.CompletedProcess[str]:
    """The exit code of `python -m PROGRAM ...`, and what it prints but for its log: in this process, because a start of
    Python takes longer than most commands."""
    arguments = [*map(str, words)]
    return run_here(lambda: import_module(f"{program}.__main__").execute(arguments), ROOT)


def run_here(execute: Callable[[], int | None], folder: Path) -> subprocess.CompletedProcess[str]:
    """The same of a command that `execute` runs, in a folder."""
    out, err = io.StringIO(), io.StringIO()
    with chdir(folder), redirect_stdout(out), redirect_stderr(err):
        try:
            code = exit_code(execute)
        except SystemExit as end:  # of --help
            code = end.code
    assert isinstance(code, int)
    return subprocess.CompletedProcess((), code, out.getvalue(), err.getvalue())


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
