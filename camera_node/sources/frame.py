# SPDX-License-Identifier: BSD-3-Clause
"""Frames, the interface of their sources, and the settings and addresses with which a source is opened."""

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, Protocol

from camera_node.foundation.arrays import Grey
from camera_node.foundation.errors import ConfigError
from camera_node.protocol.messages import ControlValue

URL = re.compile(r"[A-Za-z][A-Za-z0-9+.-]*://")


@dataclass(frozen=True, slots=True)
class Frame:
    """One image: grey (h, w) uint8; `t_ns` is the middle of its exposure in this machine's Unix time.

    `error_us` bounds the varying error of `t_ns`; a constant one is the camera's time offset, which is calibrated.
    A rolling shutter reads all rows in `readout_us` (`Detections`); `t_ns` is then that of the middle of the image.
    """

    image: Grey
    t_ns: int
    exposure_us: float = 0.0
    error_us: float = 0.0
    readout_us: float = 0.0


class Source(Protocol):
    """A camera, a recording or a simulation. Iterating yields its frames until it ends or is closed.

    The defaults are those of a source that keeps up with its reader and has no exposure control.

    Attributes:
        is_recording: the frames were captured earlier, so that reading may start late without losing any.
        dropped: frames since the start that were not delivered because a newer one was available.
        incomplete: frames since the start that were discarded because parts of them did not arrive.
        lost_packets: packets since the start that never arrived.
    """

    is_recording: bool = False
    dropped: int = 0
    incomplete: int = 0
    lost_packets: int = 0

    @property
    def exposure_us(self) -> float | None:
        """The exposure time that was set, microseconds; None where the camera chooses it."""
        return None

    @property
    def gain(self) -> float | None:
        """The gain that was set, in the driver's units; None where the camera chooses it."""
        return None

    @property
    def controls(self) -> Mapping[str, ControlValue]:
        """The controls of the driver that were set, by name."""
        return {}

    def __iter__(self) -> Iterator[Frame]: ...

    def adjust(
        self,
        exposure_us: float | None = None,
        gain: float | None = None,
        controls: Mapping[str, ControlValue] | None = None,
    ) -> None:
        """Change exposure (microseconds), gain and controls by name, in order; None leaves a value unchanged.

        Raises:
            ConfigError: the source has none of these, or its camera refuses a value.
        """
        raise ConfigError("this source has no exposure, gain or controls to set")

    def close(self) -> None:
        """End the iteration, also one in another thread, and release the camera or file."""
        ...


@dataclass(frozen=True)
class SourceSettings:
    """Settings with which a source is opened; each kind of source uses those that apply to it."""

    width: int | None = None
    """Image width, pixels (cameras); the driver's choice unless given."""
    height: int | None = None
    """Image height, pixels (cameras)."""
    fps: float | None = None
    """Frames per second (cameras, and videos without timestamps.csv)."""
    exposure_us: float | None = None
    """Exposure, microseconds (cameras); automatic unless given. Short exposures keep moving roundels sharp."""
    gain: float | None = None
    """Gain in the driver's units (cameras)."""
    controls: tuple[str, ...] = ()
    """Further controls of the camera as NAME=VALUE, such as focus_absolute=30 or TriggerMode=On (cameras);
    roundel camera --list --json shows their names and limits."""
    fourcc: str | None = None
    """Pixel format, four letters such as MJPG, YUYV, GREY, "Y10 " or RGGB (cameras)."""
    scene: Path | None = None
    """The scene file of the simulated arena (--source sim); the demo's unless given."""
    epoch_ns: int | None = None
    """Unix time of the simulation's time 0, or with --stamps now of the recording's; now unless given."""
    pace: Literal["recorded", "fast"] = "recorded"
    """Deliver recorded frames at their recorded rate, or as fast as they can be read."""
    stamps: Literal["recorded", "now"] = "recorded"
    """Publish recorded times unchanged, or shift them so that the recording starts now, as a live camera would."""

    def check(self) -> None:
        """Raise ConfigError where a setting is invalid."""
        if self.fourcc is not None and not re.fullmatch("[ -~]{4}", self.fourcc):
            raise ConfigError(f"--fourcc {self.fourcc} is not a pixel format; give four letters such as MJPG")
        parse_controls(self.controls)


def parse_controls(texts: Sequence[str]) -> dict[str, ControlValue]:
    """Controls from `NAME=VALUE`; numbers, true and false become values of these types.

    Raises:
        ConfigError: a text has no name or no value.
    """
    pairs = [text.partition("=") for text in texts]
    for text, (name, _, value) in zip(texts, pairs, strict=True):
        if not name or not value:
            raise ConfigError(f"--controls {text}: give NAME=VALUE, such as focus_absolute=30")
    return {name: _parse_value(value) for name, _, value in pairs}


def _parse_value(text: str) -> ControlValue:
    if text.lower() in ("true", "false"):
        return text.lower() == "true"
    for kind in (int, float):
        try:
            return kind(text)
        except ValueError:
            continue
    return text


def is_url(source: str) -> bool:
    """Whether the value of `--source` is the address of a network stream, such as rtsp://host/stream."""
    return URL.match(source) is not None


def without_credentials(source: str) -> str:
    """A source as it may be printed: user and password before the last `@`, and the query, are replaced by `***`.

    Everything before the last `@` counts as credentials, because users do not escape `/`, `?` or `@` in a password.
    """
    scheme = match.group() if (match := URL.match(source)) else ""
    _, at, rest = source[len(scheme) :].rpartition("@")
    path, query, _ = rest.partition("?")
    return f"{scheme}{'***@' * bool(at)}{path}{'?***' * bool(query)}"
