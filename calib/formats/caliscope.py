# SPDX-License-Identifier: BSD-3-Clause
"""Caliscope (mprib/caliscope): `camera_array.toml`, or `config.toml` of older versions, and `xy.csv`.

Cameras: tables `[cameras.0]`, or `[cam_0]`, with size, matrix, distortions, fisheye, and rotation (3 x 3 or Rodrigues
vector) and translation from the world to the camera (src/caliscope/persistence.py, save_camera_array). Points: columns
sync_index, cam_id or port, point_id, img_loc_x, img_loc_y, and frame_time in seconds, by each camera's own clock.
Pixel (0, 0) is the centre of the top-left pixel, as in OpenCV.
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
from camera_node.foundation.config import write_atomically
from camera_node.foundation.errors import ConfigError
from camera_node.geometry.pose import Pose, invert, rotation_from_vector, vector_from_rotation

COLUMNS = ("sync_index", "point_id", "img_loc_x", "img_loc_y")
FROM_ZERO = PixelOrigin(0)
MAX_FRAME, MAX_MARKER = 1e12, 1e6


def read(paths: Sequence[Path], origin: PixelOrigin) -> ForeignData:
    """Read TOML files of cameras, a table of points, or both. Camera 0 is named cam0.

    Raises:
        ConfigError, CalibrationError: a file is neither, or has impossible values.
    """
    cameras: dict[str, Camera] = {}
    points = None
    for path in paths:
        if path.suffix.lower() == ".csv":
            points = _read_points(path, origin)
        else:
            cameras |= _read_cameras(path)
    return ForeignData(cameras, points)


def _read_cameras(path: Path) -> dict[str, Camera]:
    try:
        data = tomllib.loads(read_text(path))
    except (tomllib.TOMLDecodeError, RecursionError) as error:
        raise ConfigError(f"{path} is not valid TOML: {error}") from None
    tables = data.get("cameras") or {k[4:]: v for k, v in data.items() if k.startswith("cam_")}
    if not isinstance(tables, Mapping) or not tables:
        raise ConfigError(f"{path} has no tables [cameras.0] or [cam_0]")
    cameras = {}
    for number, entry in tables.items():
        if not isinstance(entry, Mapping) or not entry.get("ignore", False):
            try:
                cameras[f"cam{number}"] = _build(entry)
            except (CalibrationError, KeyError, TypeError, ValueError, IndexError) as error:
                raise ConfigError(
                    f"{path}: camera {number} has no usable size, matrix or pose: {error}"
                ) from None
    return cameras


def _build(entry: Mapping[str, Any]) -> Camera:
    K, (width, height) = np.asarray(entry["matrix"], float).reshape(3, 3), entry["size"]
    fisheye = bool(entry.get("fisheye", False))
    distortion = np.ravel(np.asarray(entry.get("distortions", ()), float)).tolist()
    pose = None
    if not any(_is_absent(entry.get(name)) for name in ("rotation", "translation")):
        rotation, T = np.asarray(entry["rotation"], float), np.eye(4)
        T[:3, :3] = rotation if rotation.shape == (3, 3) else rotation_from_vector(rotation.ravel())
        T[:3, 3] = np.ravel(np.asarray(entry["translation"], float))
        pose = Pose.from_matrix(invert(T))
    return make_camera(
        width=width,
        height=height,
        fx=float(K[0, 0]),
        fy=float(K[1, 1]),
        cx=float(K[0, 2]),
        cy=float(K[1, 2]),
        distortion=tuple(distortion),
        model="fisheye" if fisheye else "pinhole",
        T_world_cam=pose,
    )


def _is_absent(value: Any) -> bool:
    """TOML has no null: Caliscope writes the word, or leaves the entry out."""
    return value is None or isinstance(value, str) or len(value) == 0


def _read_points(path: Path, origin: PixelOrigin) -> PointTable:
    reader = csv.DictReader(io.StringIO(read_text(path)))
    have = set(reader.fieldnames or ())
    which = "cam_id" if "cam_id" in have else "port"
    if missing := sorted({*COLUMNS, which} - have):
        raise ConfigError(f"{path} lacks the columns {', '.join(missing)}; is it xy.csv of Caliscope?")
    names, rows = [], []
    for row in reader:
        try:
            values = [float(row[name]) for name in COLUMNS]
            if not (0 <= values[0] < MAX_FRAME and 0 <= values[1] < MAX_MARKER):
                raise ValueError
            time = float(row.get("frame_time") or "nan")
            names.append(f"cam{int(float(row[which]))}")
        except (TypeError, ValueError, OverflowError):
            raise ConfigError(
                f"{path}, line {reader.line_num}: a value is not a number, or out of range"
            ) from None
        rows.append([*values, time])
    if not rows:
        raise CalibrationError(f"{path} has no points")
    frame, marker, u, v, t_s = np.array(rows).T
    times = t_s if np.isfinite(t_s).all() else None
    uv = origin.read(np.column_stack([u, v]))
    return PointTable(names, frame.astype(np.intp), marker.astype(np.intp), uv, times)


def write(rig: Rig, folder: Path, origin: PixelOrigin) -> list[str]:
    """Write `camera_array.toml`; cameras are numbered in the order of the rig. Returns the names of the files.

    Raises:
        CalibrationError: the pixel origin is another than OpenCV's.
    """
    if origin != FROM_ZERO:
        raise CalibrationError("Caliscope counts pixels as OpenCV; leave out --first-pixel and --y-up")
    return _write_tables(
        folder, [_table(k, name, camera) for k, (name, camera) in enumerate(rig.cameras.items())]
    )


def _write_tables(folder: Path, tables: Sequence[str]) -> list[str]:
    write_atomically(folder / "camera_array.toml", "\n".join(tables))
    return ["camera_array.toml"]


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
