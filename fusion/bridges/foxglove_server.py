# SPDX-License-Identifier: BSD-3-Clause
"""A live server for Foxglove: poses as they arrive; cameras, bodies and images from a thread that waits for answers."""

import contextlib
import logging
import socket
import threading
from collections.abc import Iterator
from typing import Any

from camera_node.foundation.config import require_port
from camera_node.foundation.errors import AddressError, RoundelError
from camera_node.foundation.extras import require
from camera_node.foundation.rate_limit import RateLimit
from camera_node.protocol.messages import MessageError, Preview, decode
from camera_node.protocol.session import guarded
from camera_node.protocol.tcp_sockets import tcp_sockets
from fusion.bridges.foxglove_channels import FoxgloveChannels
from fusion.client.arena import Arena
from fusion.protocol.pose_messages import FusionStatus, Markers

log = logging.getLogger("fusion.foxglove")

REFRESH_S = 1.0  # what does not change is repeated: a client that connects later would not receive it
ANSWER_S = 2.0
MARKERS_HZ = 10.0


@contextlib.contextmanager
def serving(host: str, port: int, name: str) -> Iterator[tuple[FoxgloveChannels, int]]:
    """A Foxglove server; yields its channels and its port.

    Args:
        host: the address to listen on.
        port: of TCP; 0 lets the operating system choose one.
        name: what Foxglove shows.

    Raises:
        AddressError: another program uses the port, or the address is none of this machine.
        ConfigError: foxglove-sdk is missing.
    """
    foxglove = require("foxglove", "foxglove", "roundel foxglove")
    require_port(port, usual=8765)
    context = foxglove.Context()
    try:
        server = foxglove.start_server(name=name, host=host, port=port, context=context)
    except (RuntimeError, OverflowError) as error:
        text = f"can't listen on {host} port {port}: give another --host or --port ({error})"
        raise AddressError(text) from None
    try:
        send_without_delay(server.port)
        yield FoxgloveChannels(context), server.port
    finally:
        server.stop()


def send_without_delay(port: int) -> None:
    """Set TCP_NODELAY on this process's listener at a port; connections inherit it.

    The SDK does not: a message would wait until the client acknowledges the previous one, which takes up to 40 ms.
    """
    for copy in tcp_sockets():
        is_listening = copy.getsockopt(socket.SOL_SOCKET, socket.SO_ACCEPTCONN)
        if is_listening and copy.getsockname()[1:2] == (port,):
            copy.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)


class ArenaContent:
    """Cameras, bodies, unlabeled markers and images of an arena; a context manager that runs a thread.

    Args:
        client: connected to the arena.
        channels: to log to.
    """

    def __init__(self, client: Arena, channels: FoxgloveChannels) -> None:
        self._client, self._channels = client, channels
        self._status = client.status()
        self._marker_rate = RateLimit(MARKERS_HZ, 1.0)
        self._remove = client.markers().on_message(self._take_markers)
        self._rig_t_ns: int | None = None
        self._cameras: dict = {}
        self._previews: Any = None
        self._closed = threading.Event()
        self._thread = threading.Thread(target=self._run, name="content", daemon=True)

    def __enter__(self) -> "ArenaContent":
        self._thread.start()
        return self

    def __exit__(self, *exception: object) -> None:
        self._closed.set()
        self._remove()
        self._thread.join(2 * ANSWER_S)

    def _run(self) -> None:
        while not self._closed.wait(REFRESH_S):
            status = self._status.latest()
            if status is None:
                continue
            try:
                self._refresh(status)
            except RoundelError as error:  # the server restarts, or is slow: asked again
                log.debug("%s", error)

    def _refresh(self, status: FusionStatus) -> None:
        if status.rig_t_ns != self._rig_t_ns:
            self._load_rig(status)
        self._channels.add_cameras(self._cameras, status.t_ns)
        self._channels.add_bodies(self._client.declared_robots().robots, status.t_ns)
        self._subscribe_images(self._channels.wants_images(tuple(status.cameras)))

    def _load_rig(self, status: FusionStatus) -> None:
        """Request the rig in force; a server that is busy may not answer in time, and is asked again."""
        rig = self._client.rig(ANSWER_S)
        if rig is None and status.rig_t_ns is not None:
            return
        self._cameras = dict(rig.cameras) if rig else {}
        if self._rig_t_ns is not None:
            self._channels.add_log("the server uses another calibration", status.t_ns)
        self._rig_t_ns = status.rig_t_ns

    def _subscribe_images(self, is_wanted: bool) -> None:
        """Cameras send previews only while somebody subscribes."""
        if is_wanted and self._previews is None:
            take = guarded("a preview", self._take_preview)
            self._previews = self._client.session.declare_subscriber(self._client.keys.preview(), take)
        elif not is_wanted and self._previews is not None:
            self._previews.undeclare()
            self._previews = None

    def _take_preview(self, sample: Any) -> None:
        try:
            self._channels.add_image(decode(sample.payload.to_bytes(), Preview))
        except MessageError:
            self._client.faults["Preview"] += 1

    def _take_markers(self, markers: Markers) -> None:
        if self._marker_rate.passes():
            self._channels.add_markers(markers)
