# SPDX-License-Identifier: BSD-3-Clause
"""The V4L2 cameras of this machine: how they are found and described, and their frames.

Frames are read and decoded by OpenCV, controls by the kernel's own requests.
"""

import logging
import os
import re
import time
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any, Protocol

import cv2

from camera_node.clocks.host_clock import unix_ahead_ns
from camera_node.foundation.errors import CameraAbsentError, CameraError, ConfigError
from camera_node.protocol.messages import ControlValue
from camera_node.sources.camera_description import CameraDescription, Control, Mode, check_controls
from camera_node.sources.frame import Frame, SourceSettings, without_credentials
from camera_node.sources.grey import RAW, to_grey
from camera_node.sources.live import Capture, LiveSource
from camera_node.sources.v4l2_kernel import (
    ENUM_FMT,
    ENUM_FRAMEINTERVALS,
    ENUM_FRAMESIZES,
    QUERYCAP,
    Capability,
    ControlSet,
    FormatDescription,
    FrameInterval,
    FrameSize,
    KernelDevice,
)

log = logging.getLogger("camera_node.device")

SYS = Path("/sys/class/video4linux")
DEV = Path("/dev")
CAPTURE = 1  # V4L2_BUF_TYPE_VIDEO_CAPTURE
DISCRETE = 1  # V4L2_FRMSIZE_TYPE_DISCRETE, V4L2_FRMIVAL_TYPE_DISCRETE
CAP_CAPTURE, CAP_MEDIA_CONTROLLER = 0x1, 0x20000000
# Devices of a Raspberry Pi that deliver nothing without libcamera, or are no cameras: read those by `picamera:`.
NO_CAMERAS = re.compile(r"unicam|rp1-cfe|pispbe|bcm2835-(isp|codec)|rpi-hevc|rpivid")
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


def find_device(text: str, sys: Path = SYS) -> Path:
    """Find a camera's device file from its number, path or name.

    Args:
        text: `2`, `/dev/video2`, or a name as in `<sys>/video2/name`.
        sys: the folder in which the kernel lists cameras.

    A name that no camera has is an error; a number or a path may become right when a camera is plugged in.

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
    raise CameraError(
        f"no folder, video or camera '{without_credentials(text)}'; {present(names)}. A camera that is plugged "
        "in later needs its path: /dev/video0, or one of /dev/v4l/by-id"
    )


def camera_names(sys: Path = SYS) -> dict[Path, str]:
    """Device files and names of this machine's cameras, without their metadata devices (index > 0)."""
    found = sorted(sys.glob("video*"), key=lambda entry: (len(entry.name), entry.name))
    names = {
        DEV / entry.name: _read(entry / "name") for entry in found if _read(entry / "index") in ("", "0")
    }
    return {device: name for device, name in names.items() if not NO_CAMERAS.match(name)}


def present(names: dict[Path, str]) -> str:
    """The cameras of this machine, for an error."""
    cameras = ", ".join(f"{device} ({name})" for device, name in names.items())
    return f"cameras present: {cameras}" if cameras else "this machine has no camera"


def device_key(device: Path, sys: Path = SYS) -> str:
    """Identifies a camera by its serial number, or by its place on the bus if it has none or shares it with another."""
    serial = _usb_id(device, sys)
    twins = [other for other in camera_names(sys) if other != device and _usb_id(other, sys) == serial]
    if serial and not twins:
        return f"usb {serial}"
    place = sys / device.name / "device"
    return f"bus {place.resolve()}" if place.exists() else f"device {device}"


def list_v4l2(sys: Path = SYS) -> list[CameraDescription]:
    """The V4L2 cameras of this machine, with modes and controls of those that open."""
    return [d for device, name in camera_names(sys).items() if (d := describe(device, name, sys)) is not None]


def describe(device: Path, name: str, sys: Path = SYS) -> CameraDescription | None:
    """A camera with its modes and controls; None for a device that captures no video by itself."""
    serial = _read((sys / device.name / "device").resolve().parent / "serial")
    try:
        opened = KernelDevice(device)
    except CameraAbsentError as error:
        return CameraDescription("v4l2", str(device), name, serial, note=str(error))
    try:
        capability = Capability()
        if not (opened.ask(QUERYCAP, capability) and _captures(capability)):
            return None
        controls = tuple(ControlSet(opened, str(device)).offered().values())
        return CameraDescription("v4l2", str(device), name, serial, _modes(opened), controls)
    except OSError as error:
        return CameraDescription("v4l2", str(device), name, serial, note=f"does not answer: {error.strerror}")
    finally:
        opened.close()


def _captures(capability: Capability) -> bool:
    caps = capability.device_caps or capability.capabilities
    return bool(caps & CAP_CAPTURE) and not caps & CAP_MEDIA_CONTROLLER


def _modes(device: KernelDevice) -> tuple[Mode, ...]:
    formats = [f.pixelformat for f in device.items(ENUM_FMT, FormatDescription(type=CAPTURE))]
    return tuple(
        Mode(width, height, _letters(pixels), _fastest(device, pixels, width, height))
        for pixels in formats
        for width, height in _sizes(device, pixels)
    )


def _sizes(device: KernelDevice, pixels: int) -> list[tuple[int, int]]:
    """All sizes of a pixel format; of a range, the largest."""
    sizes = []
    for entry in device.items(ENUM_FRAMESIZES, FrameSize(pixel_format=pixels)):
        if entry.type != DISCRETE:
            return [(entry.size[1], entry.size[4])]
        sizes.append((entry.size[0], entry.size[1]))
    return sizes


def _fastest(device: KernelDevice, pixels: int, width: int, height: int) -> float | None:
    """The greatest frame rate, Hz; None where the driver does not state it."""
    asked = FrameInterval(pixel_format=pixels, width=width, height=height)
    rates = []
    for entry in device.items(ENUM_FRAMEINTERVALS, asked):
        numerator, denominator = entry.interval[0], entry.interval[1]
        rates.append(denominator / numerator if numerator else 0.0)
        if entry.type != DISCRETE:  # the first is the shortest
            break
    return max(rates, default=None)


def _letters(pixels: int) -> str:
    """A pixel format by its four letters."""
    return pixels.to_bytes(4, "little").decode("ascii", errors="replace")


def _usb_id(device: Path, sys: Path) -> str:
    """Vendor, product, serial number and interface of a USB camera; empty without a serial number."""
    interface = (sys / device.name / "device").resolve()
    values = [_read(interface.parent / name) for name in ("idVendor", "idProduct", "serial")]
    return ":".join([*values, _read(interface / "bInterfaceNumber")]) if all(values) else ""


def _read(path: Path) -> str:
    try:
        return path.read_text(errors="replace").strip()
    except OSError:
        return ""


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
