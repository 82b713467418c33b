# SPDX-License-Identifier: BSD-3-Clause
"""`python -m camera_node`: publishes the detections of one camera."""

import contextlib
import signal
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

import tyro

from camera_node.config import example_file, require_name
from camera_node.errors import CameraError
from camera_node.simulation.camera import SimulatedCamera
from camera_node.sources.address import is_url, without_credentials
from camera_node.sources.frame import Source, SourceSettings
from camera_node.sources.replay import FrameFolder, PacedSource, VideoFile
from camera_node.sources.v4l2 import V4l2Source, find_device


@dataclass(frozen=True)
class Publish:
    """Publish every roundel of every frame of one camera over Zenoh, until stopped.

    To detect in single images: python -m camera_node detect IMAGE...
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
    """A Zenoh configuration file (JSON5) for TLS, access control or scouting."""
    detector: Literal["chords", "paper"] = "chords"
    """The search method; paper is the reference method of Faigl et al., ICRA 2013."""
    inner_ratios: tuple[float, ...] = ()
    """Inner over outer diameters of the prints in use, such as 0.6; without any, they are found."""
    settings: Annotated[SourceSettings, tyro.conf.OmitArgPrefixes] = field(default_factory=SourceSettings)

    def run(self) -> None:
        """Open the source and the session, publish until the source ends or a signal arrives, and close both."""
        import cv2

        from camera_node.detection.detector import Detector
        from camera_node.node.node import Node
        from camera_node.protocol.session import open_client

        require_name(self.name, "a camera")
        require_name(self.arena, "an arena")
        signal.signal(signal.SIGTERM, signal.default_int_handler)
        cv2.setNumThreads(1)  # a machine runs one process for each of its cameras
        with contextlib.ExitStack() as stack:
            source = open_source(self.source, self.settings, self.name)
            stack.callback(source.close)
            session = stack.enter_context(open_client(self.connect, self.zenoh))
            detector = Detector(detector=self.detector, inner_ratios=self.inner_ratios)
            keep_stamps = source.is_recording and self.settings.stamps == "recorded"
            node = Node(self.name, source, detector, session, self.arena, keep_stamps)
            with contextlib.suppress(KeyboardInterrupt):
                node.run()


def open_source(text: str, settings: SourceSettings, name: str = "cam0") -> Source:
    """Open the source that `--source` names: `sim`, a folder, a video file, or a camera by number, path or name.

    Args:
        text: the value of `--source`.
        settings: each kind of source uses those that apply to it.
        name: the camera's name in a simulated arena.

    Raises:
        CameraError: the source does not exist or does not open.
        ConfigError: a setting is invalid, or a simulation has no scene.
    """
    settings.check()
    if text == "sim":
        return _open_simulation(settings, name)
    if is_url(text):
        raise CameraError(
            f"{without_credentials(text)} is a network stream, which can't be read yet; give a camera"
        )
    if Path(text).is_dir():
        return PacedSource(FrameFolder(Path(text)), settings)
    if Path(text).is_file():
        return PacedSource(VideoFile(Path(text), settings.fps), settings)
    return V4l2Source(find_device(text), settings)


def _open_simulation(settings: SourceSettings, name: str) -> Source:
    scene = settings.scene or example_file("demo/scene.yaml")
    epoch_ns = time.time_ns() if settings.epoch_ns is None else settings.epoch_ns
    return SimulatedCamera(scene, name, epoch_ns)
