# SPDX-License-Identifier: BSD-3-Clause
"""Returns freed memory to the operating system, which glibc's allocator does not do by itself.

Zenoh has a thread for each core and more, and glibc gives each thread an arena of its own. Messages of changing sizes
leave free memory in all of them, so that the resident memory of a program grows for hours although it uses no more.
`malloc_trim` returns what is free at the end of the first arena only, so all threads share that one.
"""

import ctypes
import platform
import threading
import time

M_ARENA_MAX = -8  # of mallopt(3)
MAX_ARENAS = 1
PERIOD_S = 10.0  # between two returns, each of which takes 0.2 to 3 ms on a thread without the GIL


def return_freed_memory(period_s: float = PERIOD_S) -> None:
    """Share one arena between all threads, and return free pages periodically; without effect where glibc is not used.

    To be called before the program starts threads.

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
