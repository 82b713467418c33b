# SPDX-License-Identifier: BSD-3-Clause
"""The TCP sockets of this process: libraries that open them have no setting for some of their options."""

import contextlib
import os
import socket
import stat
import struct
from collections import Counter
from collections.abc import Iterator

DESCRIPTORS = "/dev/fd"  # of this process; on Linux /proc/self/fd
# A `struct linger`: the kernel sends after the close what is left, as it does by default.
NO_LINGER = struct.pack("ii", 0, 0)


def tcp_sockets() -> Iterator[socket.socket]:
    """A copy of each TCP socket, open until the next one: both have the same options."""
    try:
        descriptors = sorted(int(name) for name in os.listdir(DESCRIPTORS))
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


def close_excess(limit: int) -> dict[str, int]:
    """End the newest of the connections that an address has beyond `limit` to this process's listeners.

    The newest have the highest descriptors, unless older ones were closed before: then some other is ended, which
    connects again if its program lives.

    Returns:
        how many were ended, by address.
    """
    ports, n_open, closed = set[int](), Counter[str](), Counter[str]()
    for copy in tcp_sockets():
        if copy.getsockopt(socket.SOL_SOCKET, socket.SO_ACCEPTCONN):
            ports.add(copy.getsockname()[1])
    for copy in tcp_sockets():
        with contextlib.suppress(OSError):  # a listener, or a connection that was reset
            if copy.getsockname()[1] in ports:
                address = copy.getpeername()[0]
                n_open[address] += 1
                if n_open[address] > limit:
                    copy.shutdown(socket.SHUT_RDWR)
                    closed[address] += 1
    return dict(closed)


def _copy(descriptor: int) -> socket.socket | None:
    """The socket of a descriptor; None if it is none, or was closed since it was listed."""
    with contextlib.suppress(OSError):
        if stat.S_ISSOCK(os.fstat(descriptor).st_mode):
            return socket.socket(fileno=os.dup(descriptor))
    return None
