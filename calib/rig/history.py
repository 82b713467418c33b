# SPDX-License-Identifier: BSD-3-Clause
"""Rigs that were in force before: `rig.1.yaml`, `rig.2.yaml`, ... beside `rig.yaml`, the highest number the newest."""

import os
import re
import shutil
from pathlib import Path

from calib.errors import CalibrationError
from camera_node.errors import ConfigError


def predecessors(path: Path) -> list[Path]:
    """The kept rigs beside `path`, oldest first."""
    numbered = re.compile(rf"{re.escape(path.stem)}\.([0-9]+){re.escape(path.suffix)}")
    found = [(int(m[1]), p) for p in path.parent.iterdir() if (m := numbered.fullmatch(p.name))]
    return [p for _, p in sorted(found)]


def keep(path: Path) -> Path | None:
    """Keep a file under the next number before it is replaced; None where there is none yet.

    Raises:
        ConfigError: the folder can't be written to.
    """
    if not path.exists():
        return None
    try:
        kept = _next(path)
        _duplicate(path, kept)
    except OSError as error:
        raise ConfigError(f"{path} can't be kept before it is replaced: {error.strerror}") from None
    return kept


def undo(path: Path) -> tuple[Path, Path]:
    """Bring the newest kept rig back to `path`; the one that it replaces stays as `rig.undone.yaml`.

    Returns:
        the kept rig's name, which is free again, and the name under which the undone one stays.

    Raises:
        CalibrationError: nothing was kept.
        ConfigError: the folder does not exist or can't be written to.
    """
    undone = path.with_name(f"{path.stem}.undone{path.suffix}")
    try:
        if not (kept := predecessors(path)):
            raise CalibrationError(f"no earlier rig is kept beside {path}; nothing was changed")
        if path.exists():
            undone.unlink(missing_ok=True)
            _duplicate(path, undone)
        os.replace(kept[-1], path)
    except OSError as error:
        raise ConfigError(f"{path} can't be brought back: {error.strerror}; is its folder right?") from None
    return kept[-1], undone


def _next(path: Path) -> Path:
    last = predecessors(path)[-1:]
    number = int(last[0].name.removesuffix(path.suffix).rsplit(".", 1)[1]) + 1 if last else 1
    return path.with_name(f"{path.stem}.{number}{path.suffix}")


def _duplicate(path: Path, target: Path) -> None:
    """A second name for the same file, at once and never over another; a copy where the disk has no hard links."""
    try:
        os.link(path, target)
    except FileExistsError:
        raise
    except OSError:
        shutil.copy2(path, target)
