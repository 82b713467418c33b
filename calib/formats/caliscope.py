# SPDX-License-Identifier: BSD-3-Clause
"""Caliscope (mprib/caliscope): `camera_array.toml`, or `config.toml` of older versions, and `xy.csv`; and cameras of
Anipose (`calibration.toml`) and Pose2Sim (`Calib.toml`), which have the same fields and a name in each table.

Cameras: tables `[cameras.0]`, or `[cam_0]`, with size, matrix, distortions, fisheye, and rotation (3 x 3 or Rodrigues
vector) and translation from the world to the camera (src/caliscope/persistence.py, save_camera_array). Points: columns
sync_index, cam_id or port, keypoint_id (point_id before version 0.11), img_loc_x, img_loc_y; of version 0.11 also
object_id, and obj_loc_x, obj_loc_y and obj_loc_z where the tracker knows the object: then the object is the wand.
frame_time, in seconds by each camera's own clock, is a column, or in `timestamps.csv` beside. Pixel (0, 0) is the
centre of the top-left pixel, as in OpenCV.
"""

import csv
import io
import tomllib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from calib.errors import CalibrationError
from calib.formats.data import ForeignData, PixelOrigin, PointTable, make_camera, read_text
from calib.rig.camera import Camera
from calib.rig.rig import Rig
from calib.rig.wand_file import WandBody
from camera_node.foundation.arrays import Array, Index
from camera_node.foundation.config import is_name, write_atomically
from camera_node.foundation.errors import ConfigError
from camera_node.geometry.pose import invert, motion_from, vector_from_rotation

POINTS, TIMES = ("sync_index", "img_loc_x", "img_loc_y"), ("sync_index", "cam_id", "frame_time")
PLACE = ("obj_loc_x", "obj_loc_y", "obj_loc_z")
MAX_FRAME, MAX_MARKER = 1e12, 1e6
SAME_M = 1e-6  # of a point of a rigid object


def read(paths: Sequence[Path], origin: PixelOrigin) -> ForeignData:
    """Read the folder of a session, or TOML files of cameras, tables of points and of times. Camera 0 is named cam0.

    Raises:
        ConfigError, CalibrationError: a file is neither, or has impossible values.
    """
    cameras: dict[str, Camera] = {}
    tables = []
    for path in _find_files(paths):
        if path.suffix.lower() == ".csv":
            tables.append(path)
        else:
            cameras |= _read_cameras(path)
    times = [path for path in tables if path.stem.startswith("timestamps")]
    points = [path for path in tables if path not in times]
    if len(points) > 1 or len(times) > 1:
        names = ", ".join(path.name for path in (points if len(points) > 1 else times))
        raise ConfigError(f"{names} are several tables of one kind; give one of them")
    if not points:
        return ForeignData(cameras)
    stamps = _read_times(times[0]) if times else {}
    table, wand, remarks = _read_points(points[0], stamps, origin)
    return ForeignData(cameras, table, wand, remarks)


def _find_files(paths: Sequence[Path]) -> list[Path]:
    """The given files; in place of a folder, the files of a session in it."""
    found: list[Path] = []
    for path in paths:
        if not path.is_dir():
            found.append(path)
            continue
        inside = [path / "camera_array.toml", *sorted(path.glob("xy*.csv")), path / "timestamps.csv"]
        inside = [file for file in inside if file.exists() and not file.name.startswith("xyz")]
        if not inside:
            raise ConfigError(
                f"{path} has neither camera_array.toml nor xy.csv; give the folder of a session"
            )
        found += inside
    return found


def _read_cameras(path: Path) -> dict[str, Camera]:
    try:
        data = tomllib.loads(read_text(path))
    except (tomllib.TOMLDecodeError, RecursionError) as error:
        raise ConfigError(f"{path} is not valid TOML: {error}") from None
    tables = data.get("cameras") or {
        k: v for k, v in data.items() if isinstance(v, Mapping) and (k.startswith("cam_") or "matrix" in v)
    }
    if not isinstance(tables, Mapping) or not tables:
        raise ConfigError(f"{path} has no tables [cameras.0] or [cam_0]")
    cameras = {}
    for number, entry in tables.items():
        if not isinstance(entry, Mapping) or not entry.get("ignore", False):
            try:
                name = _name(number, entry)
                if name in cameras:
                    raise ConfigError(f"{path} has two cameras '{name}'; rename one")
                cameras[name] = _build(entry)
            except (CalibrationError, KeyError, TypeError, ValueError, IndexError) as error:
                raise ConfigError(
                    f"{path}: camera {number} has no usable size, matrix or pose: {error}"
                ) from None
    return cameras


def _name(key: str, entry: Mapping[str, Any]) -> str:
    """The name that a table states, else that of its key: cam0 of 0 and cam_0."""
    if is_name(stated := str(entry.get("name", ""))):
        return stated
    key = key.removeprefix("cam_")
    return f"cam{key}" if key.isdigit() or not is_name(key) else key


def _build(entry: Mapping[str, Any]) -> Camera:
    K, T = np.asarray(entry["matrix"], float).reshape(3, 3), None
    if not any(_is_absent(entry.get(name)) for name in ("rotation", "translation")):
        T = motion_from(entry["rotation"], np.asarray(entry["translation"], float))
    return make_camera(
        entry["size"],
        np.diag(K)[:2],
        K[:2, 2],
        np.ravel(np.asarray(entry.get("distortions", ()), float)),
        bool(entry.get("fisheye", False)),
        T,
    )


def _is_absent(value: Any) -> bool:
    """TOML has no null: Caliscope writes the word, or leaves the entry out."""
    return value is None or isinstance(value, str) or len(value) == 0


def _rows(path: Path, columns: Sequence[str]) -> csv.DictReader:
    """The rows of a table.

    Raises:
        ConfigError: a column is missing.
    """
    reader = csv.DictReader(io.StringIO(read_text(path)))
    have = set(reader.fieldnames or ())
    missing = [name for name in columns if not have & set(name.split("|"))]
    if missing:
        names = ", ".join(missing).replace("|", " or ")
        raise ConfigError(f"{path} lacks the columns {names}; is it a table of Caliscope?")
    return reader


def _read_times(path: Path) -> dict[tuple[int, int], float]:
    """The time of each frame, by its number and its camera's."""
    reader, times = _rows(path, TIMES), {}
    for row in reader:
        sync, camera, seconds = _numbers(path, reader.line_num, row, TIMES)
        times[int(sync), int(camera)] = seconds
    return times


def _numbers(path: Path, line: int, row: Mapping[str, str], columns: Sequence[str]) -> list[float]:
    """Finite numbers of a row.

    Raises:
        ConfigError: one is missing, or not finite or too large.
    """
    try:
        values = [float(row[name]) for name in columns]
    except (TypeError, ValueError):
        raise ConfigError(f"{path}, line {line}: a value is not a number; write the table again") from None
    if not all(abs(value) < MAX_FRAME for value in values):
        raise ConfigError(f"{path}, line {line}: a value is out of range; write the table again")
    return values


def _read_points(
    path: Path, stamps: Mapping[tuple[int, int], float], origin: PixelOrigin
) -> tuple[PointTable, WandBody | None, tuple[str, ...]]:
    """The points of the object that has most, and its shape where the table states it."""
    reader = _rows(path, (*POINTS, "cam_id|port", "keypoint_id|point_id"))
    have = set(reader.fieldnames or ())
    camera_column = "cam_id" if "cam_id" in have else "port"
    point_column = "keypoint_id" if "keypoint_id" in have else "point_id"
    columns = (*POINTS, camera_column, point_column, *(("object_id",) if "object_id" in have else ()))
    rows, places = [], []
    for row in reader:
        frame, u, v, camera, point, *objects = _numbers(path, reader.line_num, row, columns)
        if not (frame >= 0 and 0 <= camera < MAX_MARKER and 0 <= point < MAX_MARKER):
            raise ConfigError(
                f"{path}, line {reader.line_num}: a number is out of range; write the table again"
            )
        stated = row.get("frame_time") or stamps.get((int(frame), int(camera)), "nan")
        rows.append([frame, u, v, camera, point, objects[0] if objects else 0, _number_or_nan(stated)])
        places.append([_number_or_nan(row.get(name)) for name in PLACE])
    if not rows:
        raise CalibrationError(f"{path} has no points")
    table, place = np.array(rows), np.array(places)
    objects, counts = np.unique(table[:, 5], return_counts=True)
    chosen = table[:, 5] == objects[counts.argmax()]
    table, place = table[chosen], place[chosen]
    marker, wand = table[:, 4].astype(np.intp), None
    if np.isfinite(place[:, :2]).all():
        marker, wand = _read_object(marker, np.nan_to_num(place))
    timed = np.isfinite(table[:, 6])
    times = table[:, 6] if timed.all() else None
    remarks = [f"{path.name} has {len(objects)} objects; that with most points is imported"] * (
        len(objects) > 1
    )
    if times is None:
        remarks.append(
            f"{(~timed).sum()} of {len(timed)} points have no time in timestamps.csv or frame_time: frames of equal "
            "number are taken as simultaneous"
        )
    names = [f"cam{int(camera)}" for camera in table[:, 3]]
    uv = origin.read(table[:, 1:3])
    return PointTable(names, table[:, 0].astype(np.intp), marker, uv, times), wand, tuple(remarks)


def _number_or_nan(text: Any) -> float:
    try:
        value = float(text)
    except (TypeError, ValueError):
        return np.nan
    return value if abs(value) < MAX_FRAME else np.nan


def _read_object(marker: Index, place: Array) -> tuple[Index, WandBody | None]:
    """Points renumbered from 0, and the rigid body that they belong to; None if they move on it."""
    numbers, first, marker = np.unique(marker, return_index=True, return_inverse=True)
    body = place[first]
    if np.abs(place - body[marker]).max() > SAME_M:
        return numbers[marker], None
    try:
        return marker, WandBody(markers=tuple((x, y, z) for x, y, z in body.tolist()))
    except ValueError as error:
        raise CalibrationError(f"the object of the points: {error}") from None


def write(rig: Rig, folder: Path, origin: PixelOrigin) -> list[str]:
    """Write `camera_array.toml`; cameras are numbered in the order of the rig. Returns the names of the files.

    Raises:
        CalibrationError: the pixel origin is another than OpenCV's.
    """
    origin.require_opencv("Caliscope")
    tables = [_table(k, name, camera) for k, (name, camera) in enumerate(rig.cameras.items())]
    write_atomically(folder / "camera_array.toml", "\n".join(tables))
    return ["camera_array.toml"]


def write_anipose(rig: Rig, folder: Path, origin: PixelOrigin) -> list[str]:
    """Write `calibration.toml` of Anipose and Pose2Sim, in metres; return its name.

    Raises:
        CalibrationError: the pixel origin is another than OpenCV's, or a camera has no pose.
    """
    origin.require_opencv("Anipose")
    if bare := [name for name, camera in rig.cameras.items() if camera.T_world_cam is None]:
        raise CalibrationError(f"camera '{bare[0]}' has no pose; run roundel calibrate wand, or leave it out")
    tables = []
    for k, (name, camera) in enumerate(rig.cameras.items()):
        table = _table(k, name, camera).splitlines()[2:]
        kept = [line for line in table if not line.startswith(("cam_id", "rotation_count", "ignore"))]
        tables.append("\n".join([f"[cam_{k}]", f'name = "{name}"', *kept]) + "\n")
    tables.append("[metadata]\nadjusted = false\nerror = 0.0\n")
    write_atomically(folder / "calibration.toml", "\n".join(tables))
    return ["calibration.toml"]


def _table(number: int, name: str, camera: Camera) -> str:
    lines = [f"# {name}", f"[cameras.{number}]", f"cam_id = {number}", "rotation_count = 0", "ignore = false"]
    lines += [f"size = [{camera.width}, {camera.height}]", f"matrix = {camera.K.tolist()}"]
    lines += [f"distortions = {list(camera.distortion or (0.0,) * 5)}"]
    lines += [f"fisheye = {str(camera.model == 'fisheye').lower()}"]
    if camera.T_world_cam is not None:
        T = invert(camera.matrix())
        lines += [
            f"rotation = {vector_from_rotation(T[:3, :3]).tolist()}",
            f"translation = {T[:3, 3].tolist()}",
        ]
    return "\n".join(lines) + "\n"
