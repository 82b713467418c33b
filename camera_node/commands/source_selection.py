# SPDX-License-Identifier: BSD-3-Clause
"""The source that `--source` names: a recording, a camera of this machine, or a rendered arena."""

import time
from pathlib import Path

from camera_node.errors import ConfigError
from camera_node.simulation.camera import SimulatedCamera
from camera_node.sources.frame import Source, SourceSettings
from camera_node.sources.replay import FolderSource, PacedSource, VideoSource
from camera_node.sources.v4l2 import V4l2Source, find_device


def open_source(text: str, settings: SourceSettings, name: str = "cam0") -> Source:
    """The source that `--source` names: `sim`, a folder, a video file, or a camera by number, path or name.

    Args:
        text: what `--source` says.
        settings: as far as this kind of source knows them.
        name: the camera's name, by which a simulation knows it.

    Raises:
        CameraError: there is no such source, or it does not open.
        ConfigError: a setting that can't be, or a simulation without a scene.
    """
    settings.check()
    if text == "sim":
        return _open_simulation(settings, name)
    if Path(text).is_dir():
        return PacedSource(FolderSource(Path(text)), settings)
    if Path(text).is_file():
        return PacedSource(VideoSource(Path(text), settings.fps), settings)
    return V4l2Source(find_device(text), settings)


def _open_simulation(settings: SourceSettings, name: str) -> Source:
    if settings.scene is None:
        raise ConfigError("--source sim needs an arena: add --scene FILE, such as configs/demo/scene.yaml")
    epoch_ns = time.time_ns() if settings.epoch_ns is None else settings.epoch_ns
    return SimulatedCamera(settings.scene, name, epoch_ns)
