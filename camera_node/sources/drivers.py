# SPDX-License-Identifier: BSD-3-Clause
"""The drivers of cameras: which of them reads what `--source` names, and the cameras that each of them finds."""

from collections.abc import Callable
from dataclasses import dataclass

from camera_node.foundation.errors import CameraError, ConfigError
from camera_node.sources.description import CameraDescription
from camera_node.sources.frame import Source, SourceSettings
from camera_node.sources.genicam.source import genicam_key, list_genicam, open_genicam
from camera_node.sources.picamera import list_picamera, local_picameras, open_picamera, picamera_key
from camera_node.sources.v4l2.devices import camera_names, device_key, find_device, list_v4l2
from camera_node.sources.v4l2.source import open_v4l2


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
