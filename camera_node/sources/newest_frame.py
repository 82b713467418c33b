# SPDX-License-Identifier: BSD-3-Clause
"""Hands the newest frame from the thread that reads a camera to the one that detects."""

import threading
from collections.abc import Iterator

from camera_node.sources.frame import Frame


class NewestFrame:
    """Iterating yields the newest frame, each at most once, until `close`.

    Attributes:
        dropped: frames that a newer one replaced before they were read.
    """

    def __init__(self) -> None:
        self.dropped = 0
        self._latest: Frame | None = None
        self._arrived = threading.Condition()
        self._is_closed = False

    def put(self, frame: Frame) -> None:
        """Replace the frame that waits."""
        with self._arrived:
            self.dropped += self._latest is not None
            self._latest = frame
            self._arrived.notify_all()

    def close(self) -> None:
        """End the iteration, also one in another thread."""
        with self._arrived:
            self._is_closed = True
            self._arrived.notify_all()

    def __iter__(self) -> Iterator[Frame]:
        while True:
            with self._arrived:
                self._arrived.wait_for(lambda: self._latest or self._is_closed)
                if self._is_closed:
                    return
                frame, self._latest = self._latest, None
            if frame is not None:
                yield frame
