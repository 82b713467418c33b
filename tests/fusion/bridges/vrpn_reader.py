# SPDX-License-Identifier: BSD-3-Clause
"""A VRPN bridge in a process, and a client after VRPN's source that shows times, velocities and every message."""

import contextlib
import socket
import struct
from collections.abc import Iterator

from tests.conftest import free_port
from tests.fusion.bridges.pose_server import bridge
from tests.processes import first_line
from tests.waiting import DEADLINE_S


@contextlib.contextmanager
def serving(endpoint: str) -> Iterator[int]:
    """The port of a VRPN bridge."""
    port = free_port()
    with bridge("vrpn", "--connect", endpoint, "--port", str(port)) as process:
        assert str(port) in first_line(process)
        yield port


class VrpnReader:
    """A client over TCP that decodes what arrives; with `udp`, it asks for reports by UDP."""

    def __init__(self, port: int, udp: bool = False) -> None:
        self.connection = socket.create_connection(("127.0.0.1", port), DEADLINE_S)
        self.datagrams = socket.socket(type=socket.SOCK_DGRAM)
        self.datagrams.bind(("127.0.0.1", 0))
        self.datagrams.settimeout(DEADLINE_S)
        self.names: dict[tuple[int, int], str] = {}
        self.connection.sendall(b"vrpn: ver. 07.35  0\0\0\0\0\0")
        assert self.exactly(24).startswith(b"vrpn: ver. 07.")
        if udp:
            self.send(-3, self.datagrams.getsockname()[1], b"127.0.0.1\0")

    def __enter__(self) -> "VrpnReader":
        return self

    def __exit__(self, *exception: object) -> None:
        self.connection.close()
        self.datagrams.close()

    def await_names(self, count: int) -> None:
        """Read until so many senders are described."""
        while sum(kind == -1 for kind, _ in self.names) < count:
            self.read()

    def exactly(self, size: int) -> bytes:
        data = b""
        while len(data) < size:
            part = self.connection.recv(size - len(data))
            assert part, "the server closed the connection"
            data += part
        return data

    def send(self, kind: int, sender: int, body: bytes) -> None:
        header = struct.pack(">6i", 24 + len(body), 0, 0, sender, kind, 0)
        self.connection.sendall(header + body + bytes(-len(body) % 8))

    def next(self) -> tuple[str, str, int, bytes]:
        """Sender, type, time (ns) and body of the next message that is no description."""
        while (message := self.read()) is None:
            pass
        return message

    def read(self) -> tuple[str, str, int, bytes] | None:
        header = self.exactly(24)
        length = struct.unpack(">i", header[:4])[0]
        return self.decode(header + self.exactly(length - 24 + -length % 8))

    def datagram(self) -> list[tuple[str, str, int, bytes]]:
        """The messages of the next UDP datagram."""
        data, messages = self.datagrams.recv(2048), []
        while data:
            size = struct.unpack(">i", data[:4])[0]
            messages.append(self.decode(data[: size + -size % 8]))
            data = data[size + -size % 8 :]
        return messages

    def decode(self, data: bytes) -> tuple[str, str, int, bytes] | None:
        length, seconds, microseconds, sender, kind, _ = struct.unpack(">5iI", data[:24])
        body = data[24:length]
        if kind in (-1, -2):
            assert struct.unpack(">i", body[:4])[0] == len(body) - 4
            self.names[kind, sender] = body[4:].rstrip(b"\0").decode()
            return None
        return self.names[-1, sender], self.names[-2, kind], seconds * 10**9 + microseconds * 1000, body
