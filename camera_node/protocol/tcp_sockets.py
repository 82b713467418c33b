# SPDX-License-Identifier: BSD-3-Clause
"""The TCP sockets of this process: libraries that open them have no setting for some of their options."""

import contextlib
import os
import socket
import stat
import struct
from collections.abc import Iterator

DESCRIPTORS = "/dev/fd"  # of this process; on Linux /proc/self/fd
# A `struct linger`: the kernel sends after the close what is left, as it does by default.
NO_LINGER = struct.pack("ii", 0, 0)


def tcp_sockets() -> Iterator[socket.socket]:
    """A copy of each TCP socket, open until the next one: both have the same options."""
    try:
        descriptors = [int(name) for name in os.listdir(DESCRIPTORS)]
    except OSError:  # a container without /proc
        return
    for descriptor in descriptors:
        if (copy := _copy(descriptor)) is not None:
            with copy:
                if copy.family in (socket.AF_INET, socket.AF_INET6) and copy.type == socket.SOCK_STREAM:
                    yield copy


def stop_lingering() -> int:
    """Switch SO_LINGER off for all TCP sockets of this process; returns for how many it was on.

    Zenoh sets it to 10 s. Closing a socket whose last bytes are not acknowledged then blocks the thread for as long,
    and Zenoh closes them in threads that serve all connections (its issue 1101): a server that has lost two programs
    receives from no other one. Zenoh has no option for it.
    """
    changed = 0
    for copy in tcp_sockets():
        with contextlib.suppress(OSError):  # the connection was reset
            if copy.getsockopt(socket.SOL_SOCKET, socket.SO_LINGER):
                copy.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, NO_LINGER)
                changed += 1
    return changed


def _copy(descriptor: int) -> socket.socket | None:
    """The socket of a descriptor; None if it is none, or was closed since it was listed."""
    with contextlib.suppress(OSError):
        if stat.S_ISSOCK(os.fstat(descriptor).st_mode):
            return socket.socket(fileno=os.dup(descriptor))
    return None
