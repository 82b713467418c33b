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
MAX_IMAGE_PX = 64e6  # pixels of one image; the server computes a table of the lens in 3 s and 0.7 GB
MAX_RIG_PX = 1e9  # pixels of all images together
FOCAL_PX = (1.0, 1e6)
MAX_CENTRE = 10.0  # of the principal point, in images' sides: a cropped image may not contain it
MAX_DISTORTION = 1e6
MAX_POSITION_M = 1e5
QUATERNION_NORM = (1e-6, 1e6)
MAX_TIME_OFFSET_MS = 86_400_000.0  # a day: recordings of one session
MAX_TIME_DRIFT_PPM = 1e5  # three times the largest drift that a calibration estimates
MAX_COVARIANCE = 1e12
MAX_ERROR_COLUMNS = ERRORS * MAX_JOINT
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
    if camera.width * camera.height > MAX_IMAGE_PX:
        return f"an image of {camera.width} x {camera.height} px; the limit is {MAX_IMAGE_PX:.0e} px"
    if not all(FOCAL_PX[0] <= f <= FOCAL_PX[1] for f in (camera.fx, camera.fy)):
        return f"the focal lengths fx and fy must be within {FOCAL_PX[0]:g} and {FOCAL_PX[1]:g} px"
    if abs(camera.cx) > MAX_CENTRE * camera.width or abs(camera.cy) > MAX_CENTRE * camera.height:
        return "the principal point cx, cy is far outside of the image"
    if any(abs(k) > MAX_DISTORTION for k in camera.distortion):
        return f"a distortion number is beyond {MAX_DISTORTION:g}"
    if not abs(camera.time_offset_ms) <= MAX_TIME_OFFSET_MS:  # NaN is not
        return f"time_offset_ms must be within {MAX_TIME_OFFSET_MS:g} ms"
    if not (abs(camera.time_drift_ppm) <= MAX_TIME_DRIFT_PPM and 0 <= camera.time_reference_ns < 2**63):
        return f"time_drift_ppm must be within {MAX_TIME_DRIFT_PPM:g}, and time_reference_ns a stamp"
    if not abs(camera.readout_us or 0.0) <= MAX_READOUT_US:
        return f"readout_us must be within {MAX_READOUT_US:g}"
    return _find_fault_of_pose(camera)


def _find_fault_of_pose(camera: Camera) -> str:
    if (pose := camera.T_world_cam) is not None:
        if max(map(abs, pose.position_m)) > MAX_POSITION_M:
            return f"position_m must be within {MAX_POSITION_M:g} m"
        if not QUATERNION_NORM[0] <= math.hypot(*pose.wxyz) <= QUATERNION_NORM[1]:
            return f"the norm of wxyz must be within {QUATERNION_NORM[0]:g} and {QUATERNION_NORM[1]:g}"
    if (covariance := camera.covariance) is not None:
        if len(covariance) != 6 or any(len(row) != 6 for row in covariance):
            return "covariance must be 6 x 6"
        if not all(abs(x) <= MAX_COVARIANCE for row in covariance for x in row):
            return f"the covariance must be finite and within {MAX_COVARIANCE:g}"
        if min(covariance[k][k] for k in range(6)) < 0:
            return "a variance is below 0"
    return _find_fault_of_errors(camera.errors)


def _find_fault_of_errors(errors: tuple[tuple[float, ...], ...] | None) -> str:
    if errors is None:
        return ""
    width = len(errors[0]) if errors else 0
    if (
        len(errors) != ERRORS
        or any(len(row) != width for row in errors)
        or not 0 < width <= MAX_ERROR_COLUMNS
    ):
        return f"errors must have {ERRORS} equal rows of at most {MAX_ERROR_COLUMNS} numbers"
    if not all(abs(x) <= MAX_COVARIANCE for row in errors for x in row):
        return f"the numbers of errors must be finite and within {MAX_COVARIANCE:g}"
    return ""


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
