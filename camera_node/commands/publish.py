# SPDX-License-Identifier: BSD-3-Clause
"""`python -m camera_node`: publishes what one camera sees."""

import contextlib
import signal
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

import tyro

from camera_node.commands.source_selection import open_source
from camera_node.config import is_name
from camera_node.errors import ConfigError
from camera_node.sources.frame import SourceSettings
from camera_node.sources.replay import PacedSource


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

        from camera_node.node.node import Node
        from camera_node.protocol.session import open_client

        _check_name("name", self.name)
        _check_name("arena", self.arena)
        signal.signal(signal.SIGTERM, signal.default_int_handler)
        cv2.setNumThreads(1)  # a camera is one process of several on its machine
        with contextlib.ExitStack() as stack:
            source = open_source(self.source, self.settings, self.name)
            stack.callback(source.close)
            session = stack.enter_context(open_client(self.connect, self.zenoh))
            keep_stamps = isinstance(source, PacedSource) and self.settings.stamps == "recorded"
            detector = {"detector": self.detector, "inner_ratios": self.inner_ratios}
            with contextlib.suppress(KeyboardInterrupt):
                Node(self.name, source, session, self.arena, detector, keep_stamps).run()


def _check_name(option: str, name: str) -> None:
    if not is_name(name):
        raise ConfigError(
            f"--{option} '{name}' can't be a part of a Zenoh key: leave out / * $ # ? and spaces"
        )
