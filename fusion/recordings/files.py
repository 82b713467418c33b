# SPDX-License-Identifier: BSD-3-Clause
"""Renames and removes recordings."""

from pathlib import Path

from camera_node.foundation.config import require_name
from camera_node.foundation.errors import ConfigError

SUFFIX = ".mcap"


def recording_path(folder: Path, name: str) -> Path:
    """The file of a recording with a name, with or without its suffix. Raises ConfigError for what is no name."""
    return folder / f"{require_name(name.removesuffix(SUFFIX), 'a recording')}{SUFFIX}"


def rename_recording(recording: Path, name: str) -> Path:
    """Give a recording another name in its folder; return its new path.

    Raises:
        ConfigError: it is no recording, the name is invalid or taken, or the folder can't be written.
    """
    _require_recording(recording)
    new = recording_path(recording.parent, name)
    if new.exists():
        raise ConfigError(f"{new} exists; give another name")
    try:
        return recording.rename(new)
    except OSError as error:
        raise ConfigError(f"{recording} can't be renamed: {error.strerror}") from None


def remove_recording(recording: Path) -> None:
    """Delete a recording for good. Raises ConfigError if it is no recording, or its folder can't be written."""
    _require_recording(recording)
    try:
        recording.unlink()
    except OSError as error:
        raise ConfigError(f"{recording} can't be removed: {error.strerror}") from None


def _require_recording(path: Path) -> None:
    if path.suffix != SUFFIX:
        raise ConfigError(f"{path} is no recording; name a file that ends with {SUFFIX}")
    if not path.is_file():
        raise ConfigError(
            f"{path} does not exist; roundel recordings list {path.parent} lists the recordings"
        )
