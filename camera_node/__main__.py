# SPDX-License-Identifier: BSD-3-Clause
"""The command line: `python -m camera_node` publishes a camera; `detect` looks at images, `print` makes roundels."""

import contextlib
import logging
import signal
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

import tyro

from camera_node.config import is_name
from camera_node.errors import ConfigError, check_command, run
from camera_node.frame import SourceSettings
from camera_node.replay import Replay
from camera_node.source import open_source


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
    detector: Literal["chords", "paper"] = "chords"
    """Which search; paper is that of Faigl et al., ICRA 2013, the reference."""
    inner_ratios: tuple[float, ...] = (0.6, 0.41)
    """Inner over outer diameters of the roundels in use."""
    settings: Annotated[SourceSettings, tyro.conf.OmitArgPrefixes] = field(default_factory=SourceSettings)

    def run(self) -> None:
        """Open everything, publish until the source ends or a signal comes, and close everything."""
        import cv2

        from camera_node.network import open_client
        from camera_node.node import Node

        _check_name("name", self.name)
        _check_name("arena", self.arena)
        signal.signal(signal.SIGTERM, signal.default_int_handler)
        cv2.setNumThreads(1)  # a camera is one process of several on its machine
        with contextlib.ExitStack() as stack:
            source = open_source(self.source, self.settings, self.name)
            stack.callback(source.close)
            session = stack.enter_context(open_client(self.connect, self.zenoh))
            keep_stamps = isinstance(source, Replay) and self.settings.stamps == "recorded"
            detector = {"detector": self.detector, "inner_ratios": self.inner_ratios}
            with contextlib.suppress(KeyboardInterrupt):
                Node(self.name, source, session, self.arena, detector, keep_stamps).run()


def _check_name(option: str, name: str) -> None:
    if not is_name(name):
        raise ConfigError(
            f"--{option} '{name}' can't be a part of a Zenoh key: leave out / * $ # ? and spaces"
        )


def main() -> None:
    """The entry point of `roundel-camera`."""
    logging.basicConfig(level=logging.INFO, format="%(levelname)s %(name)s %(message)s")
    run(_program)


def _program() -> int | None:
    arguments = sys.argv[1:]
    check_command(arguments, ("detect", "print"))
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
