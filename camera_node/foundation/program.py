# SPDX-License-Identifier: BSD-3-Clause
"""The begin and the end of every program."""

import contextlib
import logging
import os
import sys
from collections.abc import Callable
from typing import NoReturn

from camera_node.foundation.allocator import return_freed_memory
from camera_node.foundation.errors import RoundelError
from camera_node.foundation.text import printable


def run(program: Callable[[], int | None]) -> NoReturn:
    """Run a command and end the process with its code; a RoundelError is one line, with its own exit code."""
    return_freed_memory()
    try:
        code = program()
    except RoundelError as error:
        print(f"error: {printable(error)}", file=sys.stderr)
        code = error.exit_code
    except KeyboardInterrupt:
        code = 130
    except BrokenPipeError:  # the reader closed the pipe, as in `detect --json | head`
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        code = 0
    end_process(code or 0)


def end_process(code: int) -> NoReturn:
    """End the process after its output is written, without Python's finalization and without `atexit`.

    Finalization would end Zenoh's threads in the middle of a callback, which aborts the process: about one in six ends
    of `roundel demo --relative` beside other programs, with "FATAL: exception not rethrown". Programs release what they
    hold, such as temporary folders, in context managers, which have ended before.
    """
    logging.shutdown()
    for stream in (sys.stdout, sys.stderr):
        with contextlib.suppress(OSError, ValueError):
            stream.flush()
    os._exit(code)
