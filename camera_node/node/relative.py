# SPDX-License-Identifier: BSD-3-Clause
"""Publishes where the roundels of each frame are relative to a calibrated camera."""

import zenoh

from camera_node.detection.relative import DiscLocalizer
from camera_node.detection.roundels import DetectedRoundels
from camera_node.protocol.messages import encode
from camera_node.protocol.relative import RelativePositions


class RelativePublisher:
    """Locates and publishes the roundels of each frame until `close`.

    Args:
        session: a Zenoh session; it stays open.
        key: the camera's key.
        localizer: with the camera's intrinsics.
    """

    def __init__(self, session: zenoh.Session, key: str, localizer: DiscLocalizer) -> None:
        self._localizer = localizer
        self._publisher = session.declare_publisher(
            key,
            congestion_control=zenoh.CongestionControl.DROP,  # old positions are useless
            priority=zenoh.Priority.REAL_TIME,
            express=True,
        )

    def put(self, roundels: DetectedRoundels, size: tuple[int, int], **header) -> None:
        """Locate and publish the roundels of one frame.

        Args:
            roundels: as detected.
            size: width and height of the image.
            header: the fields of `RelativePositions` that the frame's `Detections` have, too.

        Raises:
            ConfigError: the intrinsics are for images of another size.
        """
        self._localizer.check_size(*size)
        located = self._localizer.locate(roundels)
        message = RelativePositions.pack(located, diameter_m=self._localizer.diameter_m, **header)
        self._publisher.put(encode(message))

    def close(self) -> None:
        self._publisher.undeclare()
