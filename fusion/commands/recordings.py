# SPDX-License-Identifier: BSD-3-Clause
"""`fusion recordings`: lists the recordings of a folder."""

from pathlib import Path

from camera_node.errors import ConfigError
from camera_node.terminal import say
from fusion.recordings.summary import RecordingSummary, list_recordings


def recordings(folder: Path = Path(), /) -> int:
    """List the recordings (*.mcap) of a folder with length, size, cameras and robots, the newest first.

    Args:
        folder: the folder.
    """
    if not folder.is_dir():
        raise ConfigError(f"{folder} is not a folder; name one with recordings")
    for summary in list_recordings(folder):
        say(_line(summary))
    return 0


def _line(summary: RecordingSummary) -> str:
    length = "no index: fusion repair restores it" if summary.seconds is None else f"{summary.seconds:.1f} s"
    names = f"{len(summary.cameras)} cameras, robots {', '.join(summary.robots) or 'none'}"
    return f"{summary.path.name}: {length}, {summary.size_bytes / 1e6:.1f} MB, {names}"
