# SPDX-License-Identifier: BSD-3-Clause
"""Ends connections to dead programs without a wait.

Zenoh sets SO_LINGER of its TCP sockets to 10 s. Closing one whose last bytes nobody acknowledges then blocks the thread
for as long, and Zenoh closes them in threads that serve all connections (its issue 1101): a server that has lost two
programs receives from no other one. Zenoh has no option for it.
"""

import contextlib
import os
import socket
import stat
import struct

DESCRIPTORS = "/dev/fd"  # of this process; on Linux /proc/self/fd
# A `struct linger`: the kernel sends after the close what is left, as it does by default.
OFF = struct.pack("ii", 0, 0)


def stop_lingering() -> int:
    """Switch SO_LINGER off for all TCP sockets of this process; returns for how many it was on."""
    try:
        descriptors = [int(name) for name in os.listdir(DESCRIPTORS)]
    except OSError:  # a container without /proc
        return 0
    return sum(map(_switch_off, descriptors))


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
