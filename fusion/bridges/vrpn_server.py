# SPDX-License-Identifier: BSD-3-Clause
"""A VRPN server: each robot of an arena is a tracker. Clients connect by TCP, or ask for a connection by UDP.

VRPN has no authentication. What a client sends is bounded, and the server connects only to the address that a datagram
came from.
"""

import contextlib
import logging
import re
import selectors
import socket
import time
from collections import Counter
from collections.abc import Callable
from typing import Any

from camera_node.foundation.config import require_port
from camera_node.foundation.errors import AddressError
from fusion.bridges import vrpn_messages as vrpn
from fusion.bridges.pose_queue import WAIT_S, PoseQueue
from fusion.protocol.pose_messages import RobotPose

log = logging.getLogger("fusion.vrpn")

MAX_CLIENTS = 64
MAX_OF_ADDRESS = 16  # clients of one machine, which keep out no other one
STALL_S = 10.0  # for which a client may take nothing of what waits for it
HANDSHAKE_S = 5.0
BACKLOG = 1 << 18  # bytes that wait for a slow client, which then misses poses
DATAGRAM = 1400  # bytes, below the payload of an Ethernet frame
MAX_NAMES = 2048  # that a client may describe
CALL = re.compile(rb"[^\s\0]{1,255} (\d{1,5})\0?")  # "ADDRESS PORT": connect to me there


class VrpnClient:
    """One connection: the handshake, the client's pings, and what waits to be sent.

    Args:
        connection: a TCP socket, maybe not yet connected.
        host: the client's address.
        datagrams: the socket from which UDP is sent.
        describe: the descriptions of all our types and senders.
        sender_of: our number of a sender by its name, or None.
    """

    def __init__(
        self,
        connection: socket.socket,
        host: str,
        datagrams: socket.socket,
        describe: Callable[[], bytes],
        sender_of: Callable[[str], int | None],
    ) -> None:
        connection.setblocking(False)
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self.connection, self.host, self.dropped = connection, host, 0
        self.is_ready = False  # the client's cookie was right
        self.begun_s = self._taken_s = time.monotonic()
        self._datagrams, self._describe, self._sender_of = datagrams, describe, sender_of
        self._received, self._unsent = bytearray(), bytearray(vrpn.COOKIE)
        self._names: dict[tuple[int, int], str] = {}  # (kind of description, the client's number) -> name
        self._udp: tuple[str, int] | None = None

    @property
    def is_stalled(self) -> bool:
        """Whether it takes nothing, or what waits for it has no bound: pongs and names are sent besides poses."""
        is_silent = bool(self._unsent) and time.monotonic() - self._taken_s > STALL_S
        return is_silent or len(self._unsent) > 2 * BACKLOG

    @property
    def events(self) -> int:
        """The events to wait for, of `selectors`."""
        return selectors.EVENT_READ | (selectors.EVENT_WRITE if self._unsent else 0)

    def send(self, data: bytes) -> None:
        """Send reliably.

        Raises:
            OSError: the connection ended.
        """
        if not self._unsent:
            self._taken_s = time.monotonic()
        self._unsent += data
        with contextlib.suppress(BlockingIOError):
            while self._unsent:
                del self._unsent[: self.connection.send(self._unsent)]
                self._taken_s = time.monotonic()

    def report(self, poses: list[bytes]) -> None:
        """Send poses, by UDP if the client listens there; a client that is too slow misses them.

        Raises:
            OSError: the connection ended.
        """
        if self._udp is not None:
            for datagram in pack(poses, DATAGRAM):
                with contextlib.suppress(OSError):  # as if the network lost it
                    self._datagrams.sendto(datagram, self._udp)
        elif len(self._unsent) > BACKLOG:
            self.dropped += len(poses)
        else:
            self.send(b"".join(poses))

    def read(self) -> None:
        """Take what arrived.

        Raises:
            OSError, FormatError: the connection ended, or is not VRPN's.
        """
        try:
            data = self.connection.recv(vrpn.MAX_MESSAGE)
        except BlockingIOError:
            return
        if not data:
            raise ConnectionResetError("the client closed the connection")
        self._received += data
        if not self.is_ready and len(self._received) >= len(vrpn.COOKIE):
            if not self._received.startswith(vrpn.COOKIE_START):
                raise vrpn.FormatError("a cookie that is not of VRPN 7")
            del self._received[: len(vrpn.COOKIE)]
            self.is_ready = True
            self.send(self._describe())
        if self.is_ready:
            for message in vrpn.split(self._received):
                self._handle(message)

    def _handle(self, message: vrpn.VrpnMessage) -> None:
        if message.type in (vrpn.SENDER_DESCRIPTION, vrpn.TYPE_DESCRIPTION):
            if len(self._names) < MAX_NAMES:
                self._names[message.type, message.sender] = vrpn.name_of(message.body)
        elif message.type == vrpn.UDP_DESCRIPTION and 0 < message.sender < 1 << 16:
            self._udp = self.connection.getpeername()[0], message.sender
        elif self._names.get((vrpn.TYPE_DESCRIPTION, message.type)) == vrpn.TYPES[vrpn.PING]:
            sender = self._sender_of(self._names.get((vrpn.SENDER_DESCRIPTION, message.sender), ""))
            if sender is not None:
                self.send(vrpn.message(b"", sender, vrpn.PONG, time.time_ns()))


class VrpnServer:
    """Serves robots as trackers; a context manager.

    Args:
        host: the address to listen on.
        port: of TCP and UDP; 0 lets the operating system choose one.

    Raises:
        AddressError: another program uses the port.
        ConfigError: the port or the address is none of this machine.

    Attributes:
        port: the port in use.
        faults: skipped poses and refused clients, by reason.
    """

    def __init__(self, host: str = "127.0.0.1", port: int = 3883) -> None:
        self.faults: Counter[str] = Counter()
        self._senders: dict[str, int] = {}
        self._lost: set[str] = set()  # robots of which the clients know it
        self._sequence = 0
        self._clients: list[VrpnClient] = []
        self._selector = selectors.DefaultSelector()
        self._listener, self._datagrams = _listen(host, port)
        self.port: int = self._listener.getsockname()[1]
        self._selector.register(self._listener, selectors.EVENT_READ, self._accept)
        self._selector.register(self._datagrams, selectors.EVENT_READ, self._call)

    def __enter__(self) -> "VrpnServer":
        return self

    def __exit__(self, *exception: object) -> None:
        for client in tuple(self._clients):
            self._drop(client)
        self._selector.close()
        self._listener.close()
        self._datagrams.close()

    def step(self, poses: PoseQueue) -> None:
        """Wait for poses and clients, at most `WAIT_S`, and serve them."""
        if poses.fileno() not in self._selector.get_map():
            self._selector.register(poses, selectors.EVENT_READ)
        for key, events in self._selector.select(WAIT_S):
            if isinstance(key.data, VrpnClient):
                self._attempt(key.data, self._serve, events)
            elif key.data is not None:
                key.data()
        self.publish(poses.take())
        for client in tuple(self._clients):
            if not client.is_ready and time.monotonic() - client.begun_s > HANDSHAKE_S:
                self._drop(client, "clients that sent no cookie")
            elif client.is_stalled:
                self._drop(client, "clients that did not read")

    def publish(self, poses: list[RobotPose]) -> None:
        """Report the poses of robots that are not lost to all clients, and by a text which ones became lost."""
        data = [self._encode(pose) for pose in poses if pose.state != "lost"]
        for client in tuple(self._clients):
            if data and client.is_ready:
                self._attempt(client, VrpnClient.report, data)
        for pose in poses:
            self._report_state(pose)

    def _report_state(self, pose: RobotPose) -> None:
        is_lost = pose.state == "lost"
        if pose.robot not in self._senders or is_lost == (pose.robot in self._lost):
            return
        self._lost ^= {pose.robot}
        words = f"{pose.robot} is {pose.state}"
        self._sequence += 1
        severity = vrpn.WARNING if is_lost else vrpn.NORMAL
        data = vrpn.text(words, self._senders[pose.robot], severity, pose.t_ns, self._sequence)
        for client in tuple(self._clients):
            if client.is_ready:
                self._attempt(client, VrpnClient.send, data)

    def _encode(self, pose: RobotPose) -> bytes:
        sender = self._senders.get(pose.robot)
        if sender is None:
            log.info("publishes tracker '%s'", pose.robot)
            sender = self._senders[pose.robot] = len(self._senders)
            for client in tuple(self._clients):
                if client.is_ready:
                    text = vrpn.describe(vrpn.SENDER_DESCRIPTION, sender, pose.robot)
                    self._attempt(client, VrpnClient.send, text)
        self._sequence += 2
        return vrpn.reports(pose, sender, self._sequence)

    def _describe(self) -> bytes:
        senders = [vrpn.describe(vrpn.SENDER_DESCRIPTION, k, name) for name, k in self._senders.items()]
        return b"".join([vrpn.describe(vrpn.TYPE_DESCRIPTION, k, n) for k, n in vrpn.TYPES.items()] + senders)

    def _accept(self) -> None:
        with contextlib.suppress(OSError):  # the client is gone already
            connection, (host, _) = self._listener.accept()
            self._add(connection, host)

    def _call(self) -> None:
        """Connect to a client that asked for it by a datagram; only to the address that the datagram came from."""
        with contextlib.suppress(OSError):
            data, (host, _) = self._datagrams.recvfrom(512)
            match = CALL.fullmatch(data)
            if match is None or not 0 < int(match[1]) < 1 << 16:
                self.faults["datagrams that are not VRPN's"] += 1
                return
            connection = socket.socket()
            connection.setblocking(False)
            connection.connect_ex((host, int(match[1])))
            self._add(connection, host)

    def _add(self, connection: socket.socket, host: str) -> None:
        n_of_host = sum(client.host == host for client in self._clients)
        for n, limit, whose in (
            (len(self._clients), MAX_CLIENTS, ""),
            (n_of_host, MAX_OF_ADDRESS, f" of {host}"),
        ):
            if n >= limit:
                self.faults[f"clients beyond {limit}{whose}"] += 1
                connection.close()
                return
        client = VrpnClient(connection, host, self._datagrams, self._describe, self._senders.get)
        self._clients.append(client)
        self._selector.register(connection, client.events, client)

    def _serve(self, client: VrpnClient, events: int) -> None:
        if events & selectors.EVENT_WRITE:
            client.send(b"")
        if events & selectors.EVENT_READ:
            client.read()

    def _attempt(self, client: VrpnClient, act: Callable[..., None], argument: Any) -> None:
        """Do something with a client; drop the client if its connection ended or is not VRPN's."""
        if client not in self._clients:
            return
        try:
            act(client, argument)
            self._selector.modify(client.connection, client.events, client)
        except OSError as error:
            self._drop(client)
            log.debug("a client is gone: %s", error)
        except vrpn.FormatError:
            self._drop(client, "clients that do not speak VRPN 7")

    def _drop(self, client: VrpnClient, fault: str | None = None) -> None:
        if fault is not None:
            self.faults[fault] += 1
        if client.dropped:
            self.faults["poses that a client was too slow for"] += client.dropped
        self._clients.remove(client)
        self._selector.unregister(client.connection)
        client.connection.close()


def pack(parts: list[bytes], size: int) -> list[bytes]:
    """Join parts to datagrams of at most `size` bytes."""
    packed = [bytearray()]
    for part in parts:
        if packed[-1] and len(packed[-1]) + len(part) > size:
            packed.append(bytearray())
        packed[-1] += part
    return [bytes(datagram) for datagram in packed if datagram]


def _listen(host: str, port: int) -> tuple[socket.socket, socket.socket]:
    """Sockets of TCP and UDP on the same port."""
    require_port(port, usual=3883)
    listener, datagrams = socket.socket(), socket.socket(type=socket.SOCK_DGRAM)
    try:
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listener.bind((host, port))
        listener.listen(MAX_CLIENTS)
        datagrams.bind(listener.getsockname())
    except OSError as error:
        listener.close()
        datagrams.close()
        text = f"can't listen on {host} port {port}: {error.strerror or error}; give another --host or --port"
        raise AddressError(text) from None
    listener.setblocking(False)
    datagrams.setblocking(False)
    return listener, datagrams
