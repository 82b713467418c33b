# SPDX-License-Identifier: BSD-3-Clause
"""The V4L2 cameras of this machine: their device files, names, serial numbers, modes and controls."""

import re
from pathlib import Path

from camera_node.foundation.errors import CameraAbsentError, CameraError
from camera_node.sources.address import without_credentials
from camera_node.sources.description import CameraDescription, Mode
from camera_node.sources.v4l2.controls import ControlSet
from camera_node.sources.v4l2.kernel import (
    ENUM_FMT,
    ENUM_FRAMEINTERVALS,
    ENUM_FRAMESIZES,
    QUERYCAP,
    Capability,
    FormatDescription,
    FrameInterval,
    FrameSize,
    KernelDevice,
)

SYS = Path("/sys/class/video4linux")
DEV = Path("/dev")
CAPTURE = 1  # V4L2_BUF_TYPE_VIDEO_CAPTURE
DISCRETE = 1  # V4L2_FRMSIZE_TYPE_DISCRETE, V4L2_FRMIVAL_TYPE_DISCRETE
CAP_CAPTURE, CAP_MEDIA_CONTROLLER = 0x1, 0x20000000
# Devices of a Raspberry Pi that deliver nothing without libcamera, or are no cameras: read those by `picamera:`.
NO_CAMERAS = re.compile(r"unicam|rp1-cfe|pispbe|bcm2835-(isp|codec)|rpi-hevc|rpivid")


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
    raise CameraAbsentError(f"no folder, video or camera '{without_credentials(text)}'; {present(names)}")


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
