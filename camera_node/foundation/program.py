# SPDX-License-Identifier: BSD-3-Clause
"""The begin and the end of every program, and the memory that it returns while it runs."""

import contextlib
import ctypes
import logging
import os
import platform
import sys
import threading
import time
from collections.abc import Callable
from typing import NoReturn

from camera_node.foundation.errors import RoundelError, printable

M_ARENA_MAX = -8  # of mallopt(3)
MAX_ARENAS = 1
PERIOD_S = 10.0  # between two returns, each of which takes 0.2 to 3 ms on a thread without the GIL


def run(program: Callable[[], int | None]) -> NoReturn:
    """Run a command and end the process with its code."""
    return_freed_memory()
    end_process(exit_code(program))


def exit_code(program: Callable[[], int | None]) -> int:
    """Run a command and return its code; a RoundelError is one line on stderr, with its own exit code."""
    try:
        return program() or 0
    except RoundelError as error:
        print(f"error: {printable(error)}", file=sys.stderr)
        return error.exit_code
    except KeyboardInterrupt:
        return 130
    except BrokenPipeError:  # the reader closed the pipe, as in `detect --json | head`
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0


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


def return_freed_memory(period_s: float = PERIOD_S) -> None:
    """Share one arena between all threads, and return free pages periodically; without effect where glibc is not used.

    To be called before the program starts threads. Zenoh has a thread for each core and more, and glibc gives each
    thread an arena of its own. Messages of changing sizes leave free memory in all of them, so that the resident memory
    of a program grows for hours although it uses no more. `malloc_trim` returns what is free at the end of the first
    arena only, so all threads share that one.

    Args:
        period_s: between two returns.
    """
    if (library := glibc()) is not None:
        library.mallopt(M_ARENA_MAX, MAX_ARENAS)
        threading.Thread(target=_trim_periodically, args=(library, period_s), daemon=True).start()


def glibc() -> ctypes.CDLL | None:
    """The C library of this process; None if it is another one."""
    if platform.libc_ver()[0] != "glibc":
        return None
    library = ctypes.CDLL(None)
    library.malloc_trim.argtypes = [ctypes.c_size_t]
    return library


def _trim_periodically(library: ctypes.CDLL, period_s: float) -> None:
    while True:
        time.sleep(period_s)
        library.malloc_trim(0)
