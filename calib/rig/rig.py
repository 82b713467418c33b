# SPDX-License-Identifier: BSD-3-Clause
"""The rig: the cameras of an arena by name. Reads and writes `rig.yaml`."""

from collections.abc import Iterator
from os import PathLike
from pathlib import Path
from typing import Any, TypeVar

import msgspec

from calib.errors import CalibrationError
from calib.rig.bounds import check_cameras, check_figures
from calib.rig.camera import Camera
from calib.rig.history import History
from camera_node.foundation.config import dump_yaml, load_yaml, write_atomically
from camera_node.foundation.errors import ConfigError

T = TypeVar("T")
INTRINSICS = ("width", "height", "fx", "fy", "cx", "cy")  # the fields that every camera needs


class Rig(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The cameras of an arena, as in `rig.yaml`.

        rig = Rig.load("rig.yaml")
        print(rig["north"].T_world_cam)

    Attributes:
        cameras: lens, pose and clock of each camera, by name.
        calibration: what calibration reports of itself (free text and figures, for people and tools).
    """

    cameras: dict[str, Camera]
    calibration: dict[str, Any] = {}

    @classmethod
    def load(cls, path: str | PathLike[str]) -> "Rig":
        """Read `rig.yaml`; cameras need intrinsics, poses are optional. Raises as `load_rig`."""
        return load_rig(Path(path))

    def save(self, path: str | PathLike[str]) -> Path | None:
        """Write `rig.yaml`; returns the copy of the previous file, if there was one. Raises as `save_rig`."""
        return save_rig(self, Path(path))

    def __getitem__(self, name: str) -> Camera:
        return self.cameras[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self.cameras)

    def __post_init__(self) -> None:
        self.check()

    def check(self) -> None:
        """Raise ValueError unless all values are plausible (`calib.rig.bounds`)."""
        check_cameras(self.cameras)
        check_figures(self.calibration)

    def placed(self) -> dict[str, Camera]:
        """The cameras with a pose."""
        return {name: camera for name, camera in self.cameras.items() if camera.T_world_cam is not None}

    def require_placed(self, path: Path) -> dict[str, Camera]:
        """The cameras with a pose, of the rig that was read from `path`.

        Raises:
            CalibrationError: no camera has a pose.
        """
        placed = self.placed()
        if not placed:
            raise CalibrationError(f"no camera in {path} has a pose; run roundel calibrate wand --rig {path}")
        return placed


class _Entries(msgspec.Struct, forbid_unknown_fields=True):
    cameras: dict[str, dict[str, Any]]
    calibration: dict[str, Any] = {}


def load_rig(path: Path) -> Rig:
    """Read a rig; cameras need intrinsics, poses are optional.

    Raises:
        ConfigError: the file is missing, broken, or has an unknown field.
        CalibrationError: a camera has no intrinsics.
    """
    for name, entry in _read(path, _Entries).cameras.items():
        if missing := [key for key in INTRINSICS if key not in entry]:
            raise CalibrationError(
                f"camera '{name}' in {path} has no intrinsics ({', '.join(missing)} missing); "
                f"run roundel calibrate intrinsics --camera {name}"
            )
    rig = _read(path, Rig)
    if not rig.cameras:
        raise ConfigError(f"{path} names no camera; run roundel calibrate intrinsics")
    return rig


def _read(path: Path, kind: type[T]) -> T:
    try:
        return load_yaml(path, kind)
    except ConfigError as error:
        hint = "; is it a rig, and of this version of Roundel?" if "unknown field" in str(error) else ""
        raise ConfigError(f"{error}{hint}") from None


def save_rig(rig: Rig, path: Path, first_line: str = "") -> Path | None:
    """Write a rig atomically; fields at their defaults are omitted.

    Args:
        rig: the rig.
        path: its file.
        first_line: a comment that precedes it, such as `RigChange.line`.

    Returns:
        the backup of the previous file at `path`, if there was one (`roundel calibrate undo` restores it).

    Raises:
        CalibrationError: a value is not plausible, so that the file could not be read.
        ConfigError: the folder can't be written to.
    """
    try:
        rig.check()  # msgspec.structs.replace does not check in all versions of msgspec
    except ValueError as error:
        raise CalibrationError(f"{path} is not written: {error}") from None
    backup = History(path).back_up()
    try:
        write_atomically(path, first_line + dump_rig(rig))
    except BaseException:
        if backup:
            backup.unlink()  # equal to the file
        raise
    return backup


def dump_rig(rig: Rig) -> str:
    """The rig as YAML text, short lists on one line."""
    return dump_yaml(rig)
