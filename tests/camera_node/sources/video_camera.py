# SPDX-License-Identifier: BSD-3-Clause
"""A stand-in for a camera that ends after a few frames: a short video file, opened again from its beginning."""

import time
from collections.abc import Mapping
from pathlib import Path

import cv2
import numpy as np

from camera_node.foundation.errors import CameraError
from camera_node.protocol.messages import ControlValue
from camera_node.sources.camera_description import Control
from camera_node.sources.frame import Frame
from camera_node.sources.grey import to_grey
from camera_node.sources.live import Capture


def write_video(path: Path, levels: tuple[int, ...] = (50, 100, 150)) -> Path:
    """A video of flat frames of 64 x 48 pixels."""
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 30, (64, 48))
    for level in levels:
        writer.write(np.full((48, 64, 3), level, np.uint8))
    writer.release()
    return path


class VideoCamera(Capture):
    """A camera that delivers the frames of a video and then nothing.

    Attributes:
        adjusted: what was set, in order.
    """

    has_exposure = True
    lost_packets = 0

    def __init__(self, path: Path) -> None:
        self.name = str(path)
        self.incomplete = 1  # at each opening, as a camera that starts within a frame
        self.adjusted: list[tuple[float | None, float | None, dict[str, ControlValue]]] = []
        self.is_closed = False
        self._video = cv2.VideoCapture(str(path))

    def read(self) -> Frame:
        ok, image = self._video.read()
        if not ok or image is None:
            raise CameraError("the video ended")
        return Frame(to_grey(image), time.time_ns())

    def offered(self) -> Mapping[str, Control]:
        return {
            "focus": Control("focus", "integer", 0, 250, 5),
            "mode": Control("mode", "menu", 0, 1, entries=("day", "night")),
        }

    def adjust(
        self, exposure_us: float | None, gain: float | None, controls: Mapping[str, ControlValue]
    ) -> None:
        if gain is not None and gain > 100:
            raise CameraError(f"{self.name} refuses gain = {gain}")
        self.adjusted.append((exposure_us, gain, dict(controls)))

    def close(self) -> None:
        self.is_closed = True
        self._video.release()
