# SPDX-License-Identifier: BSD-3-Clause
"""The command line: `python -m camera_node` publishes a camera; `detect` looks at images, `print` makes roundels."""

import contextlib
import logging
import re
import signal
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import tyro

from camera_node.errors import ConfigError, run


@dataclass(frozen=True)
class Publish:
    """Publish what a camera sees: every roundel of every frame, over Zenoh, until stopped.

    To look at single images instead: python -m camera_node detect IMAGE...
    To print roundels: python -m camera_node print roundels.svg
    """

    source: str
    """A camera by number (0), path (/dev/video2) or name; a video file; a folder of <t_ns>.png|jpg; or sim."""
    name: str
    """The camera's name in the arena and in rig.yaml, such as cam0."""
    connect: tuple[str, ...] = ("tcp/127.0.0.1:7447",)
    """Zenoh endpoints of the server."""
    arena: str = "arena"
    """The arena's name, the first part of all Zenoh keys."""
    zenoh: Path | None = None
    """A Zenoh configuration (JSON5) for TLS, access control or scouting."""
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
    """Pixel format, four letters such as MJPG or YUYV (cameras)."""
    scene: Path | None = None
    """The simulated arena (--source sim)."""
    epoch_ns: int | None = None
    """Unix time of the simulation's, or with --stamps now the recording's, time 0; else it begins now."""
    pace: Literal["recorded", "fast"] = "recorded"
    """Deliver recorded frames when they are due, or as fast as they are read."""
    stamps: Literal["recorded", "now"] = "recorded"
    """Keep recorded times as they are, or move them to now, as if the recording were a camera."""
    detector: Literal["chords", "paper"] = "chords"
    """Which search; paper is that of Faigl et al., ICRA 2013, the reference."""
    inner_ratios: tuple[float, ...] = (0.6, 0.41)
    """Inner over outer diameters of the roundels in use."""

    def run(self) -> None:
        """Open everything, publish until the source ends or a signal comes, and close everything."""
        import cv2

        from camera_node.network import open_client
        from camera_node.node import Node
        from camera_node.source import Replay, open_source

        check_name("name", self.name)
        check_name("arena", self.arena)
        signal.signal(signal.SIGTERM, signal.default_int_handler)
        cv2.setNumThreads(1)  # a camera is one process of several on its machine
        with contextlib.ExitStack() as stack:
            settings = self.source_settings()
            source = open_source(self.source, settings)
            stack.callback(source.close)
            session = stack.enter_context(open_client(self.connect, self.zenoh))
            keep_stamps = isinstance(source, Replay) and settings.stamps == "recorded"
            detector = {"detector": self.detector, "inner_ratios": self.inner_ratios}
            with contextlib.suppress(KeyboardInterrupt):
                Node(self.name, source, session, self.arena, detector, keep_stamps).run()

    def source_settings(self):
        """The part of the options that is the source's."""
        from camera_node.source import SourceSettings

        if self.fourcc is not None and not re.fullmatch("[ -~]{4}", self.fourcc):
            raise ConfigError(f"--fourcc {self.fourcc} is no pixel format; give four letters such as MJPG")
        names = SourceSettings.__dataclass_fields__
        return SourceSettings(**{name: getattr(self, name) for name in names})


def check_name(option: str, name: str) -> None:
    """Raise ConfigError unless a name can be a part of a Zenoh key."""
    if not re.fullmatch(r"[^/*$#?\s]+", name):
        raise ConfigError(
            f"--{option} '{name}' can't be a part of a Zenoh key: leave out / * $ # ? and spaces"
        )


def main() -> None:
    """The entry point of `roundel-camera`."""
    logging.basicConfig(level=logging.INFO, format="%(levelname)s %(name)s %(message)s")
    run(_program)


def _program() -> int | None:
    arguments = sys.argv[1:]
    name = arguments[0] if arguments else ""
    if name == "detect":
        from camera_node.detect import Detect

        return tyro.cli(Detect, prog="camera_node detect", args=arguments[1:]).run()
    if name == "print":
        from camera_node.sheet import Sheet

        return tyro.cli(Sheet, prog="camera_node print", args=arguments[1:]).run()
    return tyro.cli(Publish, prog="camera_node", args=arguments).run()


if __name__ == "__main__":
    main()
