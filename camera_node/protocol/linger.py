# SPDX-License-Identifier: BSD-3-Clause
"""Ends connections to dead programs without a wait.

Zenoh sets SO_LINGER of its TCP sockets to 10 s. Closing one whose last bytes nobody acknowledges then blocks the thread
for as long, and Zenoh closes them in the two threads that receive for all connections (its issue 1101): a server that
has lost two programs hears no other one. Zenoh has no option for it.
"""

import contextlib
import os
import socket
import stat
import struct

DESCRIPTORS = "/dev/fd"  # of this process; on Linux /proc/self/fd
OFF = struct.pack(
    "ii", 0, 0
)  # struct linger: the kernel sends what is left after the close, as it does by default


def stop_lingering() -> int:
    """Switch SO_LINGER off for all TCP sockets of this process; returns for how many it was on."""
    return sum(map(_switch_off, map(int, os.listdir(DESCRIPTORS))))


def _switch_off(descriptor: int) -> bool:
    with contextlib.suppress(OSError):  # it was closed since it was listed
        if not stat.S_ISSOCK(os.fstat(descriptor).st_mode):
            return False
        with socket.socket(fileno=os.dup(descriptor)) as duplicate:
            is_tcp = duplicate.family in (socket.AF_INET, socket.AF_INET6)
            if is_tcp and duplicate.getsockopt(socket.SOL_SOCKET, socket.SO_LINGER):
                duplicate.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, OFF)
                return True
    return False
