# SPDX-License-Identifier: BSD-3-Clause
"""Cameras of this machine, read through Video4Linux."""

import logging
import os
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, Protocol

import cv2

from camera_node.errors import CameraAbsentError, CameraError
from camera_node.protocol.host_clock import unix_ahead_ns
from camera_node.sources.address import without_credentials
from camera_node.sources.frame import Frame, Source, SourceSettings
from camera_node.sources.grey import RAW, to_grey
from camera_node.sources.newest_frame import NewestFrame

log = logging.getLogger("camera_node.device")

SYS = Path("/sys/class/video4linux")
REOPEN_S = 1.0
CLOSE_S = 5.0  # longest wait for the thread, which may be waiting for a frame
MANUAL_EXPOSURE = 1  # V4L2_EXPOSURE_MANUAL


def find_device(text: str, sys: Path = SYS) -> Path:
    """Find a camera's device file from its number, path or name.

    Args:
        text: `2`, `/dev/video2`, or a name as in `<sys>/video2/name`.
        sys: the folder in which the kernel lists cameras.

    Raises:
        CameraError: no camera or several cameras have this name.
    """
    if text.isdecimal():
        return Path(f"/dev/video{text}")
    if text.startswith("/dev/"):
        return Path(text)
    names = camera_names(sys)
    matching = [device for device, name in names.items() if name == text]
    if len(matching) == 1:
        return matching[0]
    if matching:
        raise CameraError(
            f"several cameras have the name '{text}'; give a path: {', '.join(map(str, matching))}"
        )
    raise CameraAbsentError(f"no folder, video or camera '{without_credentials(text)}'; {_present(names)}")


def camera_names(sys: Path = SYS) -> dict[Path, str]:
    """Device files and names of this machine's cameras, without their metadata devices (index > 0)."""
    found = sorted(sys.glob("video*"), key=lambda entry: (len(entry.name), entry.name))
    return {
        Path("/dev") / entry.name: _read(entry / "name")
        for entry in found
        if _read(entry / "index") in ("", "0")
    }


def _read(path: Path) -> str:
    try:
        return path.read_text(errors="replace").strip()
    except OSError:
        return ""


def _present(names: dict[Path, str]) -> str:
    cameras = ", ".join(f"{device} ({name})" for device, name in names.items())
    return f"cameras present: {cameras}" if cameras else "this machine has no camera"


def exposure_properties(exposure_us: float | None, gain: float | None) -> list[tuple[int, float]]:
    """OpenCV's (property, value) pairs for an exposure (microseconds) and a gain; V4L2's unit is 100 us."""
    pairs: list[tuple[int, float]] = []
    if exposure_us is not None:
        pairs.append((cv2.CAP_PROP_AUTO_EXPOSURE, MANUAL_EXPOSURE))
        pairs.append((cv2.CAP_PROP_EXPOSURE, max(1, round(exposure_us / 100))))
    if gain is not None:
        pairs.append((cv2.CAP_PROP_GAIN, gain))
    return pairs


def properties(settings: SourceSettings) -> list[tuple[int, float]]:
    """(property, value) pairs of all settings, in the order that V4L2 requires: format, size, rate, exposure."""
    pairs: list[tuple[int, float]] = []
    if settings.fourcc is not None:
        pairs.append((cv2.CAP_PROP_FOURCC, cv2.VideoWriter.fourcc(*settings.fourcc)))
        if settings.fourcc in RAW:
            pairs.append((cv2.CAP_PROP_CONVERT_RGB, 0))  # otherwise OpenCV converts grey to 8-bit BGR
    for name in ("width", "height", "fps"):
        if (value := getattr(settings, name)) is not None:
            pairs.append((PROPERTY[name], value))
    return pairs + exposure_properties(settings.exposure_us, settings.gain)


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
    cv2.CAP_PROP_AUTO_EXPOSURE: "manual exposure",
    cv2.CAP_PROP_EXPOSURE: "exposure",
    cv2.CAP_PROP_GAIN: "gain",
}


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


class Capture(Protocol):
    """The methods of `cv2.VideoCapture` that `V4l2Source` uses."""

    def read(self) -> tuple[bool, Any]: ...
    def get(self, propId: int, /) -> float: ...
    def set(self, propId: int, value: float, /) -> bool: ...
    def release(self) -> None: ...


def open_capture(device: Path, settings: SourceSettings) -> cv2.VideoCapture:
    """Open a V4L2 camera and apply its settings; settings that it refuses are logged.

    Raises:
        CameraAbsentError: the device does not exist or does not open.
    """
    if not device.exists():
        raise CameraAbsentError(f"{device} does not exist; {_present(camera_names())}")
    if not os.access(device, os.R_OK | os.W_OK):
        raise CameraAbsentError(
            f"no permission to open {device}; add this user to the group video and log in again"
        )
    # Seconds after which a read of a camera that delivers nothing fails.
    os.environ.setdefault("OPENCV_VIDEOIO_V4L_SELECT_TIMEOUT", "2")
    capture = cv2.VideoCapture(str(device), cv2.CAP_V4L2)
    if not capture.isOpened():
        raise CameraAbsentError(f"{device} is not a camera, or another program uses it; close that program")
    apply(capture, properties(settings), device)
    return capture


def apply(capture: Capture, pairs: list[tuple[int, float]], device: Path) -> None:
    """Set properties of a camera; log those that it refuses."""
    for key, value in pairs:
        if not capture.set(key, value):
            log.warning("%s does not support %s = %g; its setting is unchanged", device, NAMES[key], value)


class V4l2Source(Source):
    """Delivers the newest frame of a camera; older frames that were not read in time are counted in `dropped`.

    A thread of its own grabs the frames. When the camera stops delivering, the thread logs that once and tries to
    reopen the camera until it delivers again.
    """

    def __init__(
        self,
        device: Path,
        settings: SourceSettings,
        open: Callable[[Path, SourceSettings], Capture] = open_capture,
        reopen_s: float = REOPEN_S,
    ) -> None:
        """Raises CameraError where the camera does not open."""
        self.device = device
        self._settings = settings
        self._open, self._reopen_s = open, reopen_s
        self._lost = False
        self._capture: Capture | None = open(device, settings)
        self._pending: list[tuple[int, float]] = []  # properties to set before the next frame
        self._newest = NewestFrame()
        self._setting = threading.Lock()
        self._closed = threading.Event()
        self._thread = threading.Thread(target=self._run, name=f"grab {device}", daemon=True)
        self._thread.start()

    @property
    def exposure_us(self) -> float | None:
        return self._settings.exposure_us

    @property
    def gain(self) -> float | None:
        return self._settings.gain

    @property
    def dropped(self) -> int:  # pyright: ignore[reportIncompatibleVariableOverride]: read only
        """See `Source`."""
        return self._newest.dropped

    def __iter__(self) -> Iterator[Frame]:
        return iter(self._newest)

    def adjust(self, exposure_us: float | None = None, gain: float | None = None) -> None:
        """See `Source.adjust`."""
        with self._setting:
            given = {"exposure_us": exposure_us, "gain": gain}
            self._settings = replace(self._settings, **{k: v for k, v in given.items() if v is not None})
            self._pending += exposure_properties(exposure_us, gain)

    def close(self) -> None:
        self._closed.set()
        self._newest.close()
        if threading.current_thread() is not self._thread:
            self._thread.join(CLOSE_S)

    def _run(self) -> None:
        while not self._closed.is_set():
            if not (self._grab() if self._capture else self._reopen()):
                self._closed.wait(self._reopen_s)
        if self._capture:
            self._capture.release()

    def _grab(self) -> bool:
        assert self._capture
        with self._setting:
            pairs, self._pending = self._pending, []
        apply(self._capture, pairs, self.device)
        ok, image = self._capture.read()
        if not ok or image is None:
            self._report_loss(self._capture)
            return False
        exposure_us = self._settings.exposure_us or 0.0
        stamp = self._capture.get(cv2.CAP_PROP_POS_MSEC)
        now_ns = time.monotonic_ns()
        t_ns = capture_time(stamp, now_ns, now_ns + unix_ahead_ns(), exposure_us)
        self._deliver(Frame(to_grey(image, self._settings.fourcc), t_ns, exposure_us))
        return True

    def _report_loss(self, capture: Capture) -> None:
        capture.release()
        self._capture = None
        if not self._lost:
            log.warning("%s stopped delivering frames; reopening it every %g s", self.device, self._reopen_s)
        self._lost = True

    def _deliver(self, frame: Frame) -> None:
        if self._lost:
            log.warning("%s delivers frames again", self.device)
        self._lost = False
        self._newest.put(frame)

    def _reopen(self) -> bool:
        try:
            self._capture = self._open(self.device, self._settings)
        except CameraError as error:
            log.debug("%s", error)
            return False
        return True
