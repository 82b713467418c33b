# SPDX-License-Identifier: BSD-3-Clause
"""Network streams (RTSP, MJPEG over HTTP) through PyAV. No text of this module contains credentials."""

import logging
import threading
import time
from collections.abc import Iterator
from typing import Any

import numpy as np

from camera_node.arrays import Grey
from camera_node.errors import CameraAbsentError, CameraError, ConfigError
from camera_node.extras import require
from camera_node.protocol.host_clock import unix_ahead_ns
from camera_node.sources.address import URL, without_credentials
from camera_node.sources.arrival_clock import ArrivalClock
from camera_node.sources.frame import Frame, Source
from camera_node.sources.newest_frame import NewestFrame

log = logging.getLogger("camera_node.stream")

SCHEMES = ("rtsp", "rtsps", "http", "https")
TIMEOUT_S = 5.0  # of opening and of each read
REOPEN_S = 1.0
MAX_PIXELS = 64_000_000
OPTIONS = {
    "rtsp_transport": "tcp",  # a lost UDP packet damages all frames until the next key frame
    "fflags": "nobuffer",
    "flags": "low_delay",
    "analyzeduration": "500000",  # microseconds
    "reorder_queue_size": "0",
}


class StreamSource(Source):
    """Delivers the newest frame of a stream; frames that were not read in time are counted in `dropped`.

    A thread of its own reads. When the stream ends, it logs that once and reopens it until it delivers again.

    Args:
        url: rtsp://, rtsps://, http:// or https://, with user and password if the camera needs them.
        reopen_s: time between attempts.

    Raises:
        ConfigError: the scheme is another one, or PyAV is missing.
        CameraAbsentError: the stream does not open.
    """

    def __init__(self, url: str, reopen_s: float = REOPEN_S) -> None:
        self.address = without_credentials(url)
        match = URL.match(url)
        if match is None or match.group()[:-3].lower() not in SCHEMES:
            raise ConfigError(f"{self.address} can't be read; give rtsp://, rtsps://, http:// or https://")
        self._av = require("av", "streams", "a network stream")
        self._av.logging.set_level(self._av.logging.PANIC)  # FFmpeg's own lines contain the address
        self._url, self._reopen_s = url, reopen_s
        self._newest, self._clock, self._is_lost = NewestFrame(), ArrivalClock(), False
        self._container: Any = self._open()
        self._closed = threading.Event()
        self._thread = threading.Thread(target=self._run, name=f"read {self.address}", daemon=True)
        self._thread.start()

    @property
    def dropped(self) -> int:  # pyright: ignore[reportIncompatibleVariableOverride]: read only
        """See `Source`."""
        return self._newest.dropped

    def __iter__(self) -> Iterator[Frame]:
        return iter(self._newest)

    def close(self) -> None:
        """End the iteration; the thread ends after its present read."""
        self._closed.set()
        self._newest.close()
        if threading.current_thread() is not self._thread:
            self._thread.join(2 * TIMEOUT_S)

    def _open(self) -> Any:
        try:
            container = self._av.open(self._url, options=OPTIONS, timeout=TIMEOUT_S)
        except (OSError, self._av.FFmpegError) as error:
            raise CameraAbsentError(
                f"{self.address} does not open ({_reason(error)}); check address, user and password"
            ) from None
        if not container.streams.video:
            container.close()
            raise CameraAbsentError(f"{self.address} has no video; check the address")
        container.streams.video[0].thread_type = "SLICE"  # threads by frame would hold frames back
        return container

    def _run(self) -> None:
        while not self._closed.is_set():
            try:
                with self._container:
                    self._read()
                reason = "the stream ended"
            except (OSError, CameraError, self._av.FFmpegError) as error:
                reason = _reason(error)
            if self._closed.is_set():
                return
            if not self._is_lost:
                log.warning(
                    "%s delivers no frames (%s); reopening it every %g s",
                    self.address,
                    reason,
                    self._reopen_s,
                )
            self._is_lost = True
            self._reopen()

    def _read(self) -> None:
        """Deliver frames until the stream or this source ends."""
        stream = self._container.streams.video[0]
        has_times = not self._url.lower().startswith(
            "http"
        )  # FFmpeg counts the frames of HTTP streams instead
        for packet in self._container.demux(stream):
            if self._closed.is_set():
                return
            arrived_ns = time.monotonic_ns() + unix_ahead_ns()
            for picture in packet.decode():
                media_ns = round(picture.time * 1e9) if has_times and picture.time is not None else None
                t_ns, error_us = self._clock.stamp(arrived_ns, media_ns)
                self._deliver(Frame(self._grey(picture), t_ns, error_us=error_us))

    def _grey(self, picture: Any) -> Grey:
        if picture.width * picture.height > MAX_PIXELS:
            raise CameraError(f"{self.address} sends images of {picture.width} x {picture.height} pixels")
        return np.ascontiguousarray(picture.to_ndarray(format="gray"), np.uint8)

    def _deliver(self, frame: Frame) -> None:
        if self._is_lost:
            log.warning("%s delivers frames again", self.address)
        self._is_lost = False
        self._newest.put(frame)

    def _reopen(self) -> None:
        while not self._closed.wait(self._reopen_s):
            try:
                self._container = self._open()
            except CameraError as error:
                log.debug("%s", error)
                continue
            self._clock = ArrivalClock()
            return


def _reason(error: Exception) -> str:
    """The reason without the address, which FFmpeg's errors repeat with its credentials."""
    if isinstance(error, CameraError):
        return str(error)
    return str(getattr(error, "strerror", None) or type(error).__name__)
