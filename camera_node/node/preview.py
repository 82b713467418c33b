# SPDX-License-Identifier: BSD-3-Clause
"""Publishes small pictures of a camera, with the detected roundels, while anyone subscribes to them."""

import contextlib
import logging
import threading
import time
from collections.abc import Callable

import zenoh

from camera_node.detection.overlay import draw_preview
from camera_node.detection.roundels import Roundels
from camera_node.foundation.arrays import Array, Grey
from camera_node.protocol.messages import MAX_PREVIEW_BYTES, Preview, encode
from camera_node.protocol.requests import RequestError, encode_jpeg

log = logging.getLogger("camera_node.preview")

PERIOD_S = 0.3  # between two pictures
SIDE_PX = 320  # of a picture, at most
QUALITY = 60  # of the JPEG
MAX_SHARE = 0.02  # of a core: a slow machine sends fewer pictures
CLOSE_S = 5.0
Content = tuple[Grey, Roundels, tuple]  # image, its roundels, the mask's polygons


class PreviewPublisher:
    """Publishes `Preview` in a thread of its own.

    Args:
        session, key: where the pictures are published.
        camera: the camera's name.
        latest: returns the latest frame, its roundels and the mask; None before the first frame.
        now_ns: returns the server's time.
    """

    def __init__(
        self,
        session: zenoh.Session,
        key: str,
        camera: str,
        latest: Callable[[], Content | None],
        now_ns: Callable[[], int],
    ) -> None:
        self._camera, self._latest, self._now_ns = camera, latest, now_ns
        self._is_watched, self._closed = threading.Event(), threading.Event()
        self._publisher = session.declare_publisher(
            key, congestion_control=zenoh.CongestionControl.DROP, priority=zenoh.Priority.BACKGROUND
        )
        self._listener = self._publisher.declare_matching_listener(self._change_watched)
        # a status, which is always true itself; zenoh's stub says bool
        if self._publisher.matching_status.matching:  # pyright: ignore[reportAttributeAccessIssue]
            self._is_watched.set()
        self._thread = threading.Thread(target=self._run, name="preview", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Publish no more."""
        self._closed.set()
        self._is_watched.set()  # wakes the thread
        self._thread.join(CLOSE_S)
        self._listener.undeclare()
        self._publisher.undeclare()

    def _change_watched(self, status: zenoh.MatchingStatus) -> None:
        if status.matching or self._closed.is_set():
            self._is_watched.set()
        else:
            self._is_watched.clear()

    def _run(self) -> None:
        pause_s = 0.0
        while not self._closed.wait(pause_s):
            self._is_watched.wait()
            begun_s = time.thread_time()
            try:
                self._publish()
            except Exception:  # of a bug that this frame shows: the next one is another
                log.exception("a preview could not be published")
            pause_s = max(PERIOD_S, (time.thread_time() - begun_s) / MAX_SHARE)

    def _publish(self) -> None:
        content = self._latest()
        if content is None or self._closed.is_set():
            return
        image, roundels, mask = content
        height, width = image.shape
        preview = Preview(
            camera=self._camera,
            t_ns=self._now_ns(),
            width=width,
            height=height,
            jpeg=encode_preview(image, roundels, mask),
        )
        self._publisher.put(encode(preview))


def encode_preview(image: Grey, roundels: Roundels, mask: tuple[Array, ...] = ()) -> bytes:
    """A small picture of an image with its roundels and the mask drawn, as JPEG; empty if it does not fit."""
    with contextlib.suppress(RequestError):
        return encode_jpeg(draw_preview(image, roundels, mask, SIDE_PX), QUALITY, MAX_PREVIEW_BYTES)
    return b""
