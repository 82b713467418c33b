# SPDX-License-Identifier: BSD-3-Clause
"""Names a source of frames so that it is recognized after a restart and on another port."""

import socket
from dataclasses import dataclass
from pathlib import Path

from camera_node.config import is_name
from camera_node.sources.address import is_url, without_credentials
from camera_node.sources.v4l2 import SYS, camera_names, find_device

LABEL = 200  # characters


@dataclass(frozen=True, slots=True)
class SourceIdentity:
    """A source of this machine.

    Attributes:
        driver: the kind of source: sim, folder, video, stream or v4l2.
        key: the same for the same source on every start, and for no other source of this machine.
        label: for people.
        name: a name for the camera that its source suggests; empty if it suggests none.
    """

    driver: str
    key: str
    label: str
    name: str = ""


def is_simulation(text: str) -> bool:
    """Whether `--source` names a camera of a simulated arena: `sim`, or `sim:` and the camera's name there."""
    return text.partition(":")[0] == "sim"


def identify(text: str, sys: Path = SYS) -> SourceIdentity:
    """The identity of what `--source` names.

    Args:
        text: as `open_source` takes it.
        sys: the folder in which the kernel lists cameras.

    Raises:
        CameraError: there is no such camera.
    """
    host = socket.gethostname()
    if is_simulation(text):
        return SourceIdentity("sim", text, f"{text} on {host}"[:LABEL], text.partition(":")[2])
    if is_url(text):
        return SourceIdentity("stream", text, without_credentials(text)[:LABEL])
    path = Path(text)
    if path.is_dir() or path.is_file():
        driver = "folder" if path.is_dir() else "video"
        name = path.resolve().stem
        return SourceIdentity(
            driver, str(path.resolve()), f"{path} on {host}"[:LABEL], name if is_name(name) else ""
        )
    device = find_device(text, sys)
    card = camera_names(sys).get(device, "")
    return SourceIdentity("v4l2", device_key(device, sys), f"{card} ({device}) on {host}"[:LABEL])


def device_key(device: Path, sys: Path = SYS) -> str:
    """Identifies a camera by its serial number, or by its place on the bus if it has none or shares it with another."""
    serial = _serial(device, sys)
    twins = [other for other in camera_names(sys) if other != device and _serial(other, sys) == serial]
    if serial and not twins:
        return f"usb {serial}"
    place = sys / device.name / "device"
    return f"bus {place.resolve()}" if place.exists() else f"device {device}"


def _serial(device: Path, sys: Path) -> str:
    """Vendor, product, serial number and interface of a USB camera; empty without a serial number."""
    interface = (sys / device.name / "device").resolve()
    values = [_read(interface.parent / name) for name in ("idVendor", "idProduct", "serial")]
    return ":".join([*values, _read(interface / "bInterfaceNumber")]) if all(values) else ""


def _read(path: Path) -> str:
    try:
        return path.read_text(errors="replace").strip()
    except OSError:
        return ""
