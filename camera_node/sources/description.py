# SPDX-License-Identifier: BSD-3-Clause
"""What a driver states about a camera of this machine or network."""

import msgspec

from camera_node.sources.controls import Control


class Mode(msgspec.Struct, frozen=True):
    """A format of a camera's images.

    Attributes:
        width, height: pixels.
        pixels: the pixel format, as the driver calls it.
        max_fps: the greatest frame rate; None where unknown.
    """

    width: int
    height: int
    pixels: str
    max_fps: float | None = None


class CameraDescription(msgspec.Struct, frozen=True):
    """A camera.

    Attributes:
        driver: v4l2, genicam or picamera.
        source: what `--source` takes to open it.
        name: its model.
        serial: its serial number; empty without one.
        modes, controls: empty where unknown.
        note: why it can't be used now, or else.
    """

    driver: str
    source: str
    name: str
    serial: str = ""
    modes: tuple[Mode, ...] = ()
    controls: tuple[Control, ...] = ()
    note: str = ""
