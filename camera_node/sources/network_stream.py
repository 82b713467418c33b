# SPDX-License-Identifier: BSD-3-Clause
"""Network streams (RTSP, MJPEG over HTTP) through PyAV. No text of this module contains credentials."""

import errno
import socket
import time
from collections.abc import Iterator, Mapping
from itertools import chain, repeat
from typing import Any
from urllib.parse import urlsplit

import numpy as np

from camera_node.clocks.device_clock import ArrivalClock
from camera_node.clocks.host_clock import unix_ahead_ns
from camera_node.foundation.arrays import Grey
from camera_node.foundation.errors import CameraAbsentError, CameraError, ConfigError
from camera_node.foundation.extras import require
from camera_node.protocol.messages import ControlValue
from camera_node.sources.camera_description import Control
from camera_node.sources.frame import URL, Frame, without_credentials
from camera_node.sources.live import Capture, LiveSource

SCHEMES = {"rtsp": 554, "rtsps": 322, "http": 80, "https": 443}  # with their ports
TIMEOUT_S = 5.0  # of opening and of each read
# Of a lost camera: one request to connect, since a second one would follow the first after a second, a third after two
# more, and a camera that returns between them would have to wait.
CONNECT_S = 1.0
REOPEN_S = 0.5  # between attempts
MAX_PIXELS = 64_000_000
OPTIONS = {
    "rtsp_transport": "tcp",  # a lost UDP packet damages all frames until the next key frame
    "fflags": "nobuffer",
    "flags": "low_delay",
    "analyzeduration": "500000",  # microseconds
    "reorder_queue_size": "0",
}


class StreamCapture(Capture):
    """An open stream.

    Args:
        url: rtsp://, rtsps://, http:// or https://, with user and password if the camera needs them.
        connect_s: longest wait for the camera's machine to answer.

    Raises:
        ConfigError: the scheme is another one, or PyAV is missing.
        CameraAbsentError: the stream does not open.
    """

    incomplete = lost_packets = 0
    has_exposure = False

    def __init__(self, url: str, connect_s: float = TIMEOUT_S) -> None:
        self.name = without_credentials(url)
        match = URL.match(url)
        if match is None or match.group()[:-3].lower() not in SCHEMES:
            raise ConfigError(f"{self.name} can't be read; give rtsp://, rtsps://, http:// or https://")
        self._av = require("av", "streams", "a network stream")
        self._av.logging.set_level(self._av.logging.PANIC)  # FFmpeg's own lines contain the address
        self._clock = ArrivalClock()
        # FFmpeg counts the frames of HTTP streams instead of reading their times.
        self._has_times = not url.lower().startswith("http")
        self._container = self._open(url, connect_s)
        self._frames = self._decode()

    def _open(self, url: str, connect_s: float) -> Any:
        try:
            _require_answer(url, connect_s)
            container = self._av.open(url, options=OPTIONS, timeout=TIMEOUT_S)
        except (OSError, self._av.FFmpegError) as error:
            raise CameraAbsentError(
                f"{self.name} does not open ({_reason(error)}); check address, user and password"
            ) from None
        if not container.streams.video:
            container.close()
            raise CameraAbsentError(f"{self.name} has no video; check the address")
        container.streams.video[0].thread_type = "SLICE"  # threads by frame would hold frames back
        return container

    def read(self) -> Frame:
        """See `Capture.read`."""
        try:
            return next(self._frames)
        except StopIteration:
            raise CameraError("the stream ended") from None
        except (OSError, self._av.FFmpegError) as error:
            raise CameraError(_reason(error)) from None

    def offered(self) -> Mapping[str, Control]:
        """None: a stream has no way back to the camera."""
        return {}

    def adjust(
        self, exposure_us: float | None, gain: float | None, controls: Mapping[str, ControlValue]
    ) -> None:
        """Nothing can be set."""

    def close(self) -> None:
        self._container.close()

    def _decode(self) -> Iterator[Frame]:
        """The frames until the stream ends."""
        for packet in self._container.demux(self._container.streams.video[0]):
            arrived_ns = time.monotonic_ns() + unix_ahead_ns()
            for picture in packet.decode():
                media_s = picture.time if self._has_times else None
                media_ns = None if media_s is None else round(media_s * 1e9)
                t_ns, error_us = self._clock.stamp(arrived_ns, media_ns)
                yield Frame(self._grey(picture), t_ns, error_us=error_us)

    def _grey(self, picture: Any) -> Grey:
        if picture.width * picture.height > MAX_PIXELS:
            raise CameraError(f"{self.name} sends images of {picture.width} x {picture.height} pixels")
        return np.ascontiguousarray(picture.to_ndarray(format="gray"), np.uint8)


def open_stream(url: str, reopen_s: float = REOPEN_S) -> LiveSource:
    """A source of frames of a network stream; raises as `StreamCapture`."""
    waits = chain([TIMEOUT_S], repeat(CONNECT_S))
    return LiveSource(lambda settings, controls: StreamCapture(url, next(waits)), reopen_s=reopen_s)


def _require_answer(url: str, connect_s: float) -> None:
    """Raise OSError if the stream's machine does not accept a connection; FFmpeg itself has no timeout for that."""
    address = urlsplit(url)
    try:
        host, port = address.hostname, address.port or SCHEMES[address.scheme]
    except ValueError:
        return  # a password with unescaped characters, which FFmpeg may understand
    if not host:
        return
    try:
        socket.create_connection((host, port), connect_s).close()
    except TimeoutError:
        raise TimeoutError(errno.ETIMEDOUT, f"no answer within {connect_s:g} s") from None


def _reason(error: Exception) -> str:
    """The reason without the address, which FFmpeg's errors repeat with its credentials."""
    return str(getattr(error, "strerror", None) or type(error).__name__)
