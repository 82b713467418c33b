# SPDX-License-Identifier: BSD-3-Clause
"""Cameras of this machine, read through Video4Linux: frames by OpenCV, controls by the kernel's own requests."""

import logging
import os
import time
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any, Protocol

import cv2

from camera_node.clocks.host_clock import unix_ahead_ns
from camera_node.foundation.errors import CameraAbsentError, CameraError, ConfigError
from camera_node.protocol.messages import ControlValue
from camera_node.sources.controls import Control, check_controls
from camera_node.sources.frame import Frame, SourceSettings
from camera_node.sources.grey import RAW, to_grey
from camera_node.sources.live import Capture, LiveSource
from camera_node.sources.v4l2.controls import ControlSet
from camera_node.sources.v4l2.devices import camera_names, present
from camera_node.sources.v4l2.kernel import KernelDevice

log = logging.getLogger("camera_node.device")

PROPERTY = {
    "width": cv2.CAP_PROP_FRAME_WIDTH,
    "height": cv2.CAP_PROP_FRAME_HEIGHT,
    "fps": cv2.CAP_PROP_FPS,
}
NAMES = {
    cv2.CAP_PROP_FOURCC: "pixel format",
    cv2.CAP_PROP_CONVERT_RGB: "raw pixels",
    cv2.CAP_PROP_FRAME_WIDTH: "width",
    cv2.CAP_PROP_FRAME_HEIGHT: "height",
    cv2.CAP_PROP_FPS: "frame rate",
}


def properties(settings: SourceSettings) -> list[tuple[int, float]]:
    """OpenCV's (property, value) pairs of all settings, in the order that V4L2 requires: format, size, rate."""
    pairs: list[tuple[int, float]] = []
    if settings.fourcc is not None:
        pairs.append((cv2.CAP_PROP_FOURCC, cv2.VideoWriter.fourcc(*settings.fourcc)))
        if settings.fourcc in RAW:
            pairs.append((cv2.CAP_PROP_CONVERT_RGB, 0))  # otherwise OpenCV converts grey to 8-bit BGR
    for name in ("width", "height", "fps"):
        if (value := getattr(settings, name)) is not None:
            pairs.append((PROPERTY[name], value))
    return pairs


def capture_time(stamp_ms: float, monotonic_ns: int, unix_ns: int, exposure_us: float) -> int:
    """Compute the middle of an exposure, Unix nanoseconds.

    Args:
        stamp_ms: the buffer's time stamp, CLOCK_MONOTONIC; ignored unless it lies within the last second.
        monotonic_ns, unix_ns: both clocks, read at the same time just after the frame was grabbed.
        exposure_us: the exposure time; the stamp is assumed to be its end.
    """
    age = monotonic_ns - stamp_ms * 1e6
    end = unix_ns - age if 0 <= age < 1e9 else unix_ns
    return round(end - exposure_us * 500)


class Video(Protocol):
    """The methods of `cv2.VideoCapture` that `V4l2Capture` uses."""

    def read(self) -> tuple[bool, Any]: ...
    def get(self, propId: int, /) -> float: ...
    def set(self, propId: int, value: float, /) -> bool: ...
    def release(self) -> None: ...


class V4l2Capture(Capture):
    """An open V4L2 camera.

    Args:
        device: its path.
        video: OpenCV's, open.
        kernel: a second handle of the same device, for its controls.
        settings: are applied.
    """

    incomplete = lost_packets = 0
    has_exposure = True

    def __init__(self, device: Path, video: Video, kernel: KernelDevice, settings: SourceSettings) -> None:
        self.name = str(device)
        self._video, self._kernel, self._fourcc = video, kernel, settings.fourcc
        for key, value in properties(settings):
            if not video.set(key, value):
                log.warning("%s does not support %s = %g; it stays as it is", device, NAMES[key], value)
        self._controls = ControlSet(kernel, self.name)
        self._exposure_us = 0.0
        for exposure_us, gain in ((settings.exposure_us, None), (None, settings.gain)):
            try:
                self.adjust(exposure_us, gain, {})
            except CameraError as error:  # a camera without it is usable, and its picture shows the rest
                log.warning("%s", error)

    def read(self) -> Frame:
        """See `Capture.read`."""
        ok, image = self._video.read()
        if not ok or image is None:
            raise CameraError("no frame arrived in time")
        now_ns = time.monotonic_ns()
        stamp_ms = self._video.get(cv2.CAP_PROP_POS_MSEC)
        t_ns = capture_time(stamp_ms, now_ns, now_ns + unix_ahead_ns(), self._exposure_us)
        return Frame(to_grey(image, self._fourcc), t_ns, self._exposure_us)

    def offered(self) -> Mapping[str, Control]:
        """See `Capture.offered`."""
        return self._controls.offered()

    def adjust(
        self, exposure_us: float | None, gain: float | None, controls: Mapping[str, ControlValue]
    ) -> None:
        """See `Capture.adjust`."""
        self._controls.set_exposure(exposure_us, gain)
        self._exposure_us = self._exposure_us if exposure_us is None else exposure_us
        self._controls.set(controls)

    def apply(self, controls: Mapping[str, ControlValue]) -> None:
        """Check and set controls. Raises ConfigError where the camera does not offer one or refuses its value."""
        if not controls:
            return
        check_controls(controls, self.offered(), self.name)
        try:
            self._controls.set(controls)
        except CameraError as error:
            raise ConfigError(str(error)) from None

    def close(self) -> None:
        self._video.release()
        self._kernel.close()


def open_capture(
    device: Path, settings: SourceSettings, controls: Mapping[str, ControlValue] = {}
) -> V4l2Capture:
    """Open a V4L2 camera and apply its settings; a size, rate or exposure that it refuses is logged.

    Raises:
        CameraAbsentError: the device does not exist or does not open.
        ConfigError: the camera does not offer one of the controls, or refuses its value.
    """
    if not device.exists():
        raise CameraAbsentError(f"{device} does not exist; {present(camera_names())}")
    if not os.access(device, os.R_OK | os.W_OK):
        raise CameraAbsentError(
            f"no permission to open {device}; add this user to the group video and log in again"
        )
    # Seconds after which a read of a camera that delivers nothing fails.
    os.environ.setdefault("OPENCV_VIDEOIO_V4L_SELECT_TIMEOUT", "2")
    video = cv2.VideoCapture(str(device), cv2.CAP_V4L2)
    if not video.isOpened():
        raise CameraAbsentError(f"{device} is not a camera, or another program uses it; close that program")
    capture = V4l2Capture(device, video, KernelDevice(device), settings)
    try:
        capture.apply(controls)
    except BaseException:
        capture.close()
        raise
    return capture


def open_v4l2(device: Path, settings: SourceSettings) -> LiveSource:
    """A source of frames of a V4L2 camera; raises as `open_capture`, or ConfigError for invalid controls."""
    return LiveSource(partial(open_capture, device), settings)
