# SPDX-License-Identifier: BSD-3-Clause
"""The rig: the cameras of an arena by name. Reads and writes `rig.yaml`.

No file and no message beyond the bounds of a plausible rig is used.
"""

import math
from collections.abc import Iterator, Mapping
from datetime import date
from os import PathLike
from pathlib import Path
from typing import Any, TypeVar

import msgspec
import numpy as np

from calib.errors import CalibrationError
from calib.rig.camera import Camera
from calib.rig.camera_errors import ERRORS, MAX_JOINT
from calib.rig.file_history import History
from camera_node.foundation.config import NAME_RULE, dump_yaml, is_name, load_yaml, write_atomically
from camera_node.foundation.errors import ConfigError
from camera_node.protocol.messages import MAX_READOUT_US

T = TypeVar("T")
INTRINSICS = ("width", "height", "fx", "fy", "cx", "cy")  # the fields that every camera needs
MAX_CAMERAS = 256
MAX_IMAGE_PX = 64e6  # of one image: the server computes a table of the lens in 3 s and 0.7 GB
MAX_RIG_PX = 1e9  # of all images together
# The largest plausible numbers of a camera: clocks of one session (a day; three times the largest drift that a
# calibration estimates).
MOST = {
    "time_offset_ms": 86_400_000.0,
    "time_drift_ppm": 1e5,
    "readout_us": MAX_READOUT_US,
    "distortion": 1e6,
    "covariance": 1e12,
    "errors": 1e12,
}
MAX_FIGURES, MAX_DEPTH, MAX_TEXT = 50_000, 8, 10_000  # of the `calibration` map: values, nesting, characters


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
        """Raise ValueError unless all values are plausible (`calib.rig.rig`)."""
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


def check_cameras(cameras: Mapping[str, Camera]) -> None:
    """Raise ValueError, which names the camera, unless all cameras are plausible."""
    if len(cameras) > MAX_CAMERAS:
        raise ValueError(f"{len(cameras)} cameras; a rig has at most {MAX_CAMERAS}")
    for name, camera in cameras.items():
        if not is_name(name):
            raise ValueError(f"{name[:64]!r} can't name a camera; {NAME_RULE}")
        if fault := _find_fault(camera):
            raise ValueError(f"camera '{name}': {fault}")
    if sum(camera.width * camera.height for camera in cameras.values()) > MAX_RIG_PX:
        raise ValueError(f"the images have more than {MAX_RIG_PX:.0e} pixels together")


def _find_fault(camera: Camera) -> str:
    """The first value that is not plausible; empty if all are."""
    return next((fault for is_fault, fault in _possible_faults(camera) if is_fault), "")


def _possible_faults(camera: Camera) -> Iterator[tuple[bool, str]]:
    size, pose = f"an image of {camera.width} x {camera.height} px", camera.T_world_cam
    yield camera.width * camera.height > MAX_IMAGE_PX, f"{size}; the limit is {MAX_IMAGE_PX:.0e} px"
    outside = min(camera.fx, camera.fy) < 1.0 or max(camera.fx, camera.fy) > 1e6
    yield outside, "the focal lengths fx and fy must be within 1 and 1e6 px"
    outside = abs(camera.cx) > 10 * camera.width or abs(camera.cy) > 10 * camera.height
    yield (
        outside,
        "the principal point cx, cy is far outside of the image",
    )  # a cropped one may not contain it
    yield not 0 <= camera.time_reference_ns < 2**63, "time_reference_ns is no stamp"
    if pose is not None:
        yield not np.abs(pose.position_m).max() <= 1e5, "position_m must be finite and within 1e5 m"
        yield not 1e-6 <= math.hypot(*pose.wxyz) <= 1e6, "the norm of wxyz must be within 1e-6 and 1e6"
    for name, rows, widest in (("covariance", 6, 6), ("errors", ERRORS, ERRORS * MAX_JOINT)):
        if (matrix := getattr(camera, name)) is not None:
            widths = {len(row) for row in matrix}
            fits = len(matrix) == rows and len(widths) == 1 and 0 < max(widths) <= widest
            yield not fits, f"{name} must have {rows} equal rows of at most {widest} numbers"
    for name, most in MOST.items():
        value = getattr(camera, name)
        within = np.abs(np.asarray(0.0 if value is None else value)).max(initial=0.0) <= most
        yield not within, f"{name} must be finite and within {most:g}"  # NaN is not
    if camera.covariance is not None:
        yield len(camera.covariance[0]) != 6 or np.diag(camera.covariance).min() < 0, "no covariance (6, 6)"


def check_figures(figures: Mapping[str, Any]) -> None:
    """Raise ValueError unless a `calibration` map is small enough, and has only what YAML and MessagePack can hold."""
    pending: list[tuple[Any, int]] = [(figures, 0)]
    for _ in range(MAX_FIGURES):
        if not pending:
            return
        value, depth = pending.pop()
        if depth > MAX_DEPTH:
            raise ValueError(f"calibration is nested deeper than {MAX_DEPTH}")
        if isinstance(value, Mapping):
            pending += [(item, depth + 1) for pair in value.items() for item in pair]
        elif isinstance(value, list | tuple):
            pending += [(item, depth + 1) for item in value]
        else:
            _check_scalar(value)
    raise ValueError(f"calibration has more than {MAX_FIGURES} values")


def _check_scalar(value: object) -> None:
    if isinstance(value, str):
        if len(value) > MAX_TEXT or any("\ud800" <= c <= "\udfff" for c in value):
            raise ValueError(f"a text in calibration is longer than {MAX_TEXT} characters, or not Unicode")
    elif isinstance(value, int):
        if abs(value) >= 2**63:
            raise ValueError("a number in calibration has more than 64 bits")
    elif not isinstance(value, float | date | None):
        raise ValueError(f"calibration holds a value of type {type(value).__name__}")
