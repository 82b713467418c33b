# SPDX-License-Identifier: BSD-3-Clause
"""Names a source of frames so that it is recognized after a restart and on another port."""

import socket
from dataclasses import dataclass
from pathlib import Path

from camera_node.foundation.config import is_name
from camera_node.sources.address import is_url, without_credentials
from camera_node.sources.drivers import driver_of

LABEL = 200  # characters


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
