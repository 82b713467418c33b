# SPDX-License-Identifier: BSD-3-Clause
"""The drivers of cameras: which of them reads what `--source` names, and the cameras that each of them finds.

`identify` names a source of frames so that it is recognized after a restart and on another port.
"""

import socket
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from camera_node.foundation.config import is_name
from camera_node.foundation.errors import CameraError, ConfigError
from camera_node.sources.camera_description import CameraDescription
from camera_node.sources.frame import Source, SourceSettings, is_url, without_credentials
from camera_node.sources.genicam.genicam_source import genicam_key, list_genicam, open_genicam
from camera_node.sources.picamera import list_picamera, local_picameras, open_picamera, picamera_key
from camera_node.sources.v4l2_cameras import camera_names, device_key, find_device, list_v4l2, open_v4l2

LABEL = 200  # characters


@dataclass(frozen=True, slots=True)
class Driver:
    """A kind of camera.

    Attributes:
        name: before the colon of `--source`; V4L2 needs none.
        open: a camera by the text after the colon; raises CameraError or ConfigError.
        key: the same for the same camera of this machine on every start, and its model; raises CameraError.
        connected: all cameras that it reaches; raises ConfigError where a library that the driver needs is missing.
        local: the `--source` of each camera that only this machine can read, found without opening it.
    """

    name: str
    open: Callable[[str, SourceSettings], Source]
    key: Callable[[str], tuple[str, str]]
    connected: Callable[[], list[CameraDescription]]
    local: Callable[[], list[str]]


def _v4l2_key(text: str) -> tuple[str, str]:
    device = find_device(text)
    return device_key(device), f"{camera_names().get(device, '')} ({device})"


V4L2 = Driver(
    "v4l2",
    lambda text, settings: open_v4l2(find_device(text), settings),
    _v4l2_key,
    list_v4l2,
    lambda: [str(device) for device in camera_names()],
)
# Several machines can reach a GigE camera, so that each is named by --source on the machine that is to read it.
GENICAM = Driver("genicam", open_genicam, genicam_key, list_genicam, list)
PICAMERA = Driver("picamera", open_picamera, picamera_key, list_picamera, lambda: list(local_picameras()))
DRIVERS = {driver.name: driver for driver in (V4L2, GENICAM, PICAMERA)}


def driver_of(source: str) -> tuple[Driver, str]:
    """The driver that `--source` names, and the text for it."""
    name, _, rest = source.partition(":")
    return (DRIVERS[name], rest) if name in DRIVERS else (V4L2, source)


def local_cameras() -> list[str]:
    """The `--source` of each camera that only this machine can read."""
    return [source for driver in DRIVERS.values() for source in driver.local()]


def all_cameras() -> tuple[list[CameraDescription], list[str]]:
    """The cameras of all drivers, and what prevents the drivers that can't look for any."""
    found = [_found(driver) for driver in DRIVERS.values()]
    return [camera for cameras, _ in found for camera in cameras], [fault for _, fault in found if fault]


def _found(driver: Driver) -> tuple[list[CameraDescription], str]:
    try:
        return driver.connected(), ""
    except (ConfigError, CameraError) as error:
        return [], f"{driver.name}: {error}"


@dataclass(frozen=True, slots=True)
class SourceIdentity:
    """A source of this machine.

    Attributes:
        driver: the kind of source: sim, folder, video, stream, or the name of a driver of cameras.
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


def identify(text: str) -> SourceIdentity:
    """The identity of what `--source` names.

    Args:
        text: as `open_source` takes it.

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
    driver, camera = driver_of(text)
    key, label = driver.key(camera)
    return SourceIdentity(driver.name, key, f"{label} on {host}"[:LABEL])
