# SPDX-License-Identifier: BSD-3-Clause
"""`roundel recordings`: lists, renames and removes the recordings of a folder."""

from pathlib import Path
from typing import Literal

from camera_node.foundation.config import require_arguments
from camera_node.foundation.errors import ConfigError
from camera_node.foundation.terminal import say
from fusion.recordings.recording_files import (
    RecordingSummary,
    list_recordings,
    remove_recording,
    rename_recording,
)

USES = {"list": "[FOLDER]", "rename": "FILE NAME", "remove": "FILE..."}


def recordings(
    action: Literal["list", "rename", "remove"] = "list",
    arguments: tuple[str, ...] = (),
    /,
) -> int:
    """List the recordings (*.mcap) of a folder with length, size, cameras and robots, the newest first, or change them.

    Args:
        action: list [FOLDER]; rename FILE NAME, in the same folder; remove FILE... deletes them for good.
        arguments: as the action needs them.
    """
    require_arguments("recordings", action, arguments, USES[action])
    paths = [Path(word) for word in arguments]
    if action == "rename":
        say(f"{paths[0]} is called {rename_recording(paths[0], arguments[1])} from now on")
    elif action == "remove":
        for path in paths:
            remove_recording(path)
            say(f"removed {path}")
    else:
        _list(paths[0] if paths else Path())
    return 0


def _list(folder: Path) -> None:
    if not folder.is_dir():
        raise ConfigError(f"{folder} is not a folder; name one with recordings")
    found = list_recordings(folder)
    if not found:
        say(f"no recording (*.mcap) in {folder}; roundel record OUT.mcap makes one")
    for summary in found:
        say(_line(summary))


def _line(summary: RecordingSummary) -> str:
    length = "no index: roundel repair restores it" if summary.seconds is None else f"{summary.seconds:.1f} s"
    names = f"{len(summary.cameras)} cameras, robots {', '.join(summary.robots) or 'none'}"
    return f"{summary.path.name}: {length}, {summary.size_bytes / 1e6:.1f} MB, {names}"
