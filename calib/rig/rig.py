# SPDX-License-Identifier: BSD-3-Clause
"""The rig: named cameras and where they stand. Read and written as `rig.yaml`."""

from pathlib import Path
from typing import Any, TypeVar

import msgspec

from calib.errors import CalibrationError
from calib.rig.camera import Camera
from calib.rig.history import keep
from camera_node.config import dump_yaml, load_yaml, write_atomically
from camera_node.errors import ConfigError

T = TypeVar("T")


class Rig(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Cameras by name; and what calibration says of itself (free text and figures, for people and tools)."""

    cameras: dict[str, Camera]
    calibration: dict[str, Any] = {}

    def placed(self) -> dict[str, Camera]:
        """The cameras whose pose is known."""
        return {name: camera for name, camera in self.cameras.items() if camera.T_world_cam is not None}

    def require_placed(self, path: Path) -> dict[str, Camera]:
        """The placed cameras of the rig that was read from `path`.

        Raises:
            CalibrationError: fewer than one camera is placed.
        """
        placed = self.placed()
        if not placed:
            raise CalibrationError(f"{path} places no camera; run python -m calib wand --rig {path}")
        return placed


class _Entries(msgspec.Struct, forbid_unknown_fields=True):
    cameras: dict[str, dict[str, Any]]
    calibration: dict[str, Any] = {}


def load_rig(path: Path) -> Rig:
    """Read a rig; a camera without a pose is allowed, one without intrinsics is not.

    Raises:
        ConfigError: the file is missing, broken, or has a field that no rig has.
        CalibrationError: a camera has no intrinsics.
    """
    for name, entry in _read(path, _Entries).cameras.items():
        if missing := [key for key in ("width", "height", "fx", "fy", "cx", "cy") if key not in entry]:
            raise CalibrationError(
                f"camera '{name}' in {path} has no intrinsics ({', '.join(missing)} missing); "
                f"run python -m calib intrinsics --camera {name}"
            )
    rig = _read(path, Rig)
    if not rig.cameras:
        raise ConfigError(f"{path} names no camera; run python -m calib intrinsics")
    return rig


def _read(path: Path, kind: type[T]) -> T:
    try:
        return load_yaml(path, kind)
    except ConfigError as error:
        hint = "; is it a rig, and of this version of Roundel?" if "unknown field" in str(error) else ""
        raise ConfigError(f"{error}{hint}") from None


def save_rig(rig: Rig, path: Path) -> Path | None:
    """Write a rig atomically; fields at their defaults are left out.

    Returns:
        the name under which the file that was there before is kept (`calib undo` brings it back), if one was.

    Raises:
        ConfigError: the folder can't be written to.
    """
    kept = keep(path)
    try:
        write_atomically(path, dump_rig(rig))
    except BaseException:
        if kept:
            kept.unlink()
        raise
    return kept


def dump_rig(rig: Rig) -> str:
    """The rig as YAML text, short lists on one line."""
    return dump_yaml(rig)
