# SPDX-License-Identifier: BSD-3-Clause
"""Backs up files before they are replaced: `rig.1.yaml`, `rig.2.yaml`, ... beside `rig.yaml`, newest last."""

import os
import re
import shutil
from pathlib import Path

from calib.errors import CalibrationError
from camera_node.errors import ConfigError


def list_backups(path: Path) -> list[Path]:
    """The backups beside `path`, oldest first."""
    numbered = re.compile(rf"{re.escape(path.stem)}\.([0-9]+){re.escape(path.suffix)}")
    found = [(int(m[1]), p) for p in path.parent.iterdir() if (m := numbered.fullmatch(p.name))]
    return [p for _, p in sorted(found)]


def back_up(path: Path) -> Path | None:
    """Save a file under the next number; returns the backup, or None if there is no file.

    Raises:
        ConfigError: the folder can't be written to.
    """
    if not path.exists():
        return None
    try:
        backup = _next_backup(path)
        _link_or_copy(path, backup)
    except OSError as error:
        raise ConfigError(f"{path} can't be backed up: {error.strerror}") from None
    return backup


def undo(path: Path) -> tuple[Path, Path]:
    """Restore the newest backup to `path`; the file that it replaces is saved as `rig.undone.yaml`.

    Returns:
        the name of the restored backup, which no longer exists, and the name of the replaced file.

    Raises:
        CalibrationError: there is no backup.
        ConfigError: the folder does not exist or can't be written to.
    """
    undone = path.with_name(f"{path.stem}.undone{path.suffix}")
    try:
        if not (backups := list_backups(path)):
            raise CalibrationError(f"there is no earlier rig beside {path}; nothing was changed")
        if path.exists():
            undone.unlink(missing_ok=True)
            _link_or_copy(path, undone)
        os.replace(backups[-1], path)
    except OSError as error:
        raise ConfigError(f"{path} can't be restored: {error.strerror}; check its folder") from None
    return backups[-1], undone


def _next_backup(path: Path) -> Path:
    last = list_backups(path)[-1:]
    number = int(last[0].name.removesuffix(path.suffix).rsplit(".", 1)[1]) + 1 if last else 1
    return path.with_name(f"{path.stem}.{number}{path.suffix}")


def _link_or_copy(path: Path, target: Path) -> None:
    """Give a file a second name, atomically and never over another file; copy where the disk has no hard links."""
    try:
        os.link(path, target)
    except FileExistsError:
        raise
    except OSError:
        shutil.copy2(path, target)
