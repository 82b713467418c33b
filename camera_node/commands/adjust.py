# SPDX-License-Identifier: BSD-3-Clause
"""`roundel snapshot` and `roundel settings`: the image and the settings of a camera that runs."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import msgspec
import tyro
from zenoh import Session

from camera_node.foundation.config import require_name
from camera_node.foundation.errors import ConfigError, unwritable
from camera_node.foundation.terminal import say
from camera_node.protocol.camera_requests import (
    Polygon,
    mask_of,
    mask_polygon,
    next_detections,
    request_settings,
    request_snapshot,
)
from camera_node.protocol.messages import Settings
from camera_node.protocol.server_connection import LOCAL_SERVER, ConnectionOptions
from camera_node.sources.frame import parse_controls


@dataclass(frozen=True, kw_only=True)
class SaveSnapshot:
    """Save the current image of a camera that runs, as the page shows it."""

    name: Annotated[str, tyro.conf.Positional]
    """The camera's name."""
    out: Annotated[Path, tyro.conf.Positional]
    """The JPEG file to write; an existing file is replaced."""
    draw: bool = False
    """Draw the detected roundels."""
    connection: ConnectionOptions = LOCAL_SERVER

    def run(self) -> None:
        """Save the image. Raises NetworkError if the camera does not answer, ConfigError for a bad file name."""
        require_name(self.name, "a camera")
        with self.connection.open() as session:
            data = request_snapshot(session, self.connection.arena, self.name, "draw" if self.draw else "")
        save_picture(data, self.out)


def save_picture(data: bytes, out: Path) -> None:
    """Write a picture and say so. Raises ConfigError for a file that can't be written."""
    try:
        out.write_bytes(data)
    except OSError as error:
        raise unwritable(out, error) from None
    say(f"wrote {out}")


@dataclass(frozen=True, kw_only=True)
class ChangeSettings:
    """Show the settings of a camera that runs, after changing those that are given."""

    name: Annotated[str, tyro.conf.Positional]
    """The camera's name."""
    exposure_us: float | None = None
    """Exposure time, microseconds; turns automatic exposure off."""
    gain: float | None = None
    """In the driver's units."""
    controls: tuple[str, ...] = ()
    """Further controls of the camera as NAME=VALUE, such as focus_absolute=30; an unknown name lists the known ones."""
    readout_us: float | None = None
    """Time in which a rolling shutter reads all rows, microseconds; negative from the last row to the first."""
    min_contrast: float | None = None
    """Least contrast of a roundel, grey levels."""
    mask_detected: bool = False
    """Ignore the places where roundels are detected now: reflections, while no real roundel is in view."""
    mask: tuple[str, ...] = ()
    """Also ignore a rectangle, by two opposite corners U,V in pixels, or a polygon, by three or more corners."""
    clear_mask: bool = False
    """Ignore no place, except those of --mask and --mask-detected."""
    connection: ConnectionOptions = LOCAL_SERVER

    def run(self) -> None:
        """Change the settings and print those in use. Raises NetworkError, RequestError or ConfigError."""
        require_name(self.name, "a camera")
        drawn = (mask_polygon([_read_corner(text) for text in self.mask]),) if self.mask else ()
        with self.connection.open() as session:
            used = request_settings(session, self.connection.arena, self.name)
            wanted = Settings(
                exposure_us=self.exposure_us,
                gain=self.gain,
                controls=parse_controls(self.controls) or None,
                readout_us=self.readout_us,
                min_contrast=self.min_contrast,
                mask=self._changed_mask(session, used, drawn),
            )
            if wanted != Settings():
                used = request_settings(session, self.connection.arena, self.name, wanted)
        for name, value in msgspec.structs.asdict(used).items():
            if name not in ("version", "mask"):
                say(f"{name}: {'-' if value is None else value}")
        say(f"mask: {len(used.mask or ())} polygons")

    def _changed_mask(
        self, session: Session, used: Settings, drawn: tuple[Polygon, ...]
    ) -> tuple[Polygon, ...] | None:
        """The whole mask; None if it stays as it is."""
        detected = ()
        if self.mask_detected:
            detected = mask_of(next_detections(session, self.connection.arena, self.name))
        if not (drawn or detected or self.clear_mask):
            return None
        return (*(() if self.clear_mask else used.mask or ()), *drawn, *detected)


def _read_corner(text: str) -> tuple[float, float]:
    """A corner from `U,V`; raises ConfigError for any other text."""
    try:
        u, v = (float(number) for number in text.split(","))
    except ValueError:
        raise ConfigError(f"--mask {text}: give corners as U,V in pixels, such as 100,80 300,200") from None
    return u, v
