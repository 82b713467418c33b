# SPDX-License-Identifier: BSD-3-Clause
"""What a source of frames is: the frame, its source, and how one is opened."""

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, Protocol

from camera_node.arrays import Grey
from camera_node.errors import ConfigError


@dataclass(frozen=True, slots=True)
class Frame:
    """One image: grey (h, w) uint8; `t_ns` is the middle of its exposure on this machine's Unix clock."""

    image: Grey
    t_ns: int
    exposure_us: float = 0.0


class Source(Protocol):
    """A camera, a file or a simulation. Iterating ends where the source ends; a live camera's ends at `close`."""

    def __iter__(self) -> Iterator[Frame]: ...

    def close(self) -> None:
        """End the iteration, which may be another thread's, and release what is held."""
        ...


@dataclass(frozen=True)
class SourceSettings:
    """How a source is opened; each kind of source takes what it knows."""

    width: int | None = None
    """Image width, pixels (cameras); the driver's choice unless given."""
    height: int | None = None
    """Image height, pixels (cameras)."""
    fps: float | None = None
    """Frames a second (cameras, and videos without timestamps.csv)."""
    exposure_us: float | None = None
    """Exposure, microseconds (cameras); automatic unless given. Short exposures keep moving roundels sharp."""
    gain: float | None = None
    """Gain in the driver's units (cameras)."""
    fourcc: str | None = None
    """Pixel format, four letters such as MJPG, YUYV, GREY, "Y10 " or RGGB (cameras)."""
    scene: Path | None = None
    """The simulated arena (--source sim)."""
    epoch_ns: int | None = None
    """Unix time of the simulation's, or with --stamps now the recording's, time 0; else it begins now."""
    pace: Literal["recorded", "fast"] = "recorded"
    """Deliver recorded frames when they are due, or as fast as they are read."""
    stamps: Literal["recorded", "now"] = "recorded"
    """Keep recorded times as they are, or move them to now, as if the recording were a camera."""

    def check(self) -> None:
        """Raise ConfigError where a setting can't be."""
        if self.fourcc is not None and not re.fullmatch("[ -~]{4}", self.fourcc):
            raise ConfigError(f"--fourcc {self.fourcc} is no pixel format; give four letters such as MJPG")
