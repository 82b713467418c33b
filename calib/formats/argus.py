# SPDX-License-Identifier: BSD-3-Clause
"""Argus, easyWand and DLTdv: camera profiles, tables of points (`xypts.csv`) and DLT coefficients.

Profile: one row a camera, separated by spaces or commas. easyWand: number, focal length (px), width, height, cx, cy,
aspect ratio fy / fx; Argus Clicker adds r2, r4, t1, t2, r6, which are OpenCV's k1, k2, p1, p2, k3 (Argus user guide,
section "Wand", kilmoretrout/argus_gui docs/user-guide.md; easyWand: RGBsetup_profile.txt of PeppyHare/EasyWand).
Points: columns `pt1_cam1_X, pt1_cam1_Y, pt1_cam2_X, ...`, NaN where a camera did not see a point, row k is frame k; the
wand tables of easyWand have the same columns without names. DLTdv8 counts pixels from 1 at the top left, DLTdv5 to 7
and Argus from 1 at the bottom left (tlhedrick/dltdv). DLT coefficients: `dltCoefs.csv`, 11 rows, one column a camera.
"""

import csv
import io
import re
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from calib.errors import CalibrationError
from calib.formats.data import ForeignData, PixelOrigin, PointTable, make_camera, read_numbers, read_text
from calib.rig.camera import Camera
from calib.rig.rig import Rig
from camera_node.foundation.arrays import Array, Index
from camera_node.foundation.config import write_atomically
from camera_node.foundation.errors import ConfigError
from camera_node.geometry.pose import invert

DLTDV8, ARGUS = PixelOrigin(1), PixelOrigin(1, y_up=True)
COLUMN = re.compile(r"\s*pt(\d+)_cam(\d+)_([xy])\s*", re.IGNORECASE)
EASYWAND_COLUMNS, CLICKER_COLUMNS, SBA_COLUMNS = 7, 12, 17
MAX_NUMBER = 10_000  # of a point or a camera in a column's name


def read(paths: Sequence[Path], origin: PixelOrigin) -> ForeignData:
    """Read a camera profile, tables of points, or both. Cameras are named cam1, cam2, ...

    Raises:
        ConfigError, CalibrationError: a file is neither, or has impossible values.
    """
    tables = [path for path in paths if path.suffix.lower() == ".csv"]
    cameras: dict[str, Camera] = {}
    for path in paths:
        if path not in tables:
            cameras |= _read_profile(path)
    if len(tables) > 1:
        raise ConfigError(
            f"{len(tables)} tables of points; import one after the other, each with its own --out"
        )
    points = _read_points(tables[0], cameras, origin) if tables else None
    return ForeignData(cameras, points)


def _read_profile(path: Path) -> dict[str, Camera]:
    cameras = {}
    for row in read_numbers(path):
        if len(row) == SBA_COLUMNS:
            raise ConfigError(
                f"{path} is an sba profile, which has no image sizes; give the clicker profile, "
                "which Argus wrote beside it"
            )
        if len(row) not in (EASYWAND_COLUMNS, CLICKER_COLUMNS):
            raise ConfigError(
                f"{path}: a row has {len(row)} numbers; a camera profile has {EASYWAND_COLUMNS} (number, f, width, "
                f"height, cx, cy, aspect ratio) or {CLICKER_COLUMNS} (with r2, r4, t1, t2, r6); omnidirectional "
                "profiles can't be imported"
            )
        number, focal, width, height, cx, cy, ratio, *distortion = row
        lens = {"fx": focal, "fy": focal * ratio, "cx": cx, "cy": cy, "distortion": tuple(distortion)}
        cameras[f"cam{number:g}"] = make_camera(width, height, **lens)
    return cameras


def _read_points(path: Path, cameras: Mapping[str, Camera], origin: PixelOrigin) -> PointTable:
    rows = list(csv.reader(io.StringIO(read_text(path))))
    if rows and any(COLUMN.fullmatch(cell) for cell in rows[0]):
        keys, rows = _name_columns(path, rows[0]), rows[1:]
    else:
        keys = _number_columns(path, len(rows[0]) if rows else 0, len(cameras))
    values = np.full((len(rows), len(keys)), np.nan)
    for k, row in enumerate(rows):
        try:
            values[k, : len(row)] = [float(cell or "nan") for cell in row[: len(keys)]]
        except ValueError:
            raise ConfigError(f"{path}, row {k + 1}: a cell is not a number") from None
    return _collect(values, keys, cameras, origin)


def _name_columns(path: Path, header: Sequence[str]) -> list[tuple[int, int, int]]:
    """Marker from 0, camera from 1, and coordinate of each column, from its name."""
    keys = []
    for cell in header:
        match = COLUMN.fullmatch(cell)
        if match is None or not all(0 < int(n) <= MAX_NUMBER for n in match.groups()[:2]):
            raise ConfigError(f"{path}: '{cell[:40]}' does not name a column as in pt1_cam1_X")
        keys.append((int(match[1]) - 1, int(match[2]), "xy".index(match[3].lower())))
    return keys


def _number_columns(path: Path, count: int, cameras: int) -> list[tuple[int, int, int]]:
    """The same of a table without names: for each point the cameras in turn, x before y."""
    if not cameras or not count or count % (2 * cameras):
        raise ConfigError(
            f"{path} has {count} columns without names such as pt1_cam1_X; give the camera profile too, "
            "for the number of cameras"
        )
    return [(k // (2 * cameras), k // 2 % cameras + 1, k % 2) for k in range(count)]


def _collect(
    values: Array, keys: Sequence[tuple[int, int, int]], cameras: Mapping[str, Camera], origin: PixelOrigin
) -> PointTable:
    column = {key: k for k, key in enumerate(keys)}
    names: list[str] = []
    parts: list[tuple[Index, Index, Array]] = []
    for marker, camera, coordinate in keys:
        if coordinate or (marker, camera, 1) not in column:
            continue
        uv = values[:, [column[marker, camera, 0], column[marker, camera, 1]]]
        frame, name = np.flatnonzero(np.isfinite(uv).all(axis=1)), f"cam{camera}"
        height = cameras[name].height if name in cameras else None
        names += [name] * len(frame)
        parts.append((frame, np.full(len(frame), marker), origin.read(uv[frame], height)))
    if not names:
        raise CalibrationError("the table has no points: all cells are empty or NaN")
    return PointTable(names, *(np.concatenate(column) for column in zip(*parts, strict=True)))


def write(rig: Rig, folder: Path, origin: PixelOrigin) -> list[str]:
    """Write `profile.txt`, and `dltCoefs.csv` where cameras have poses; return the names of the files.

    DLT coefficients map to undistorted pixels of the same lens without distortion, as those of easyWand and Argus.

    Raises:
        CalibrationError: a lens is a fisheye, for which the formats have no place.
    """
    rows = []
    for number, (name, camera) in enumerate(rig.cameras.items(), 1):
        if camera.model != "pinhole" or len(camera.distortion) not in (0, 4, 5):
            raise CalibrationError(
                f"camera '{name}': Argus profiles have pinhole lenses with k1, k2, p1, p2, k3 only"
            )
        size = [number, camera.fx, camera.width, camera.height, camera.cx, camera.cy, camera.fy / camera.fx]
        distortion = (*camera.distortion, *[0.0] * 5)[:5]
        rows.append(" ".join(f"{value:.10g}" for value in (*size, *distortion)))
    write_atomically(folder / "profile.txt", "\n".join(rows) + "\n")
    placed = rig.placed()
    if len(placed) < len(rig.cameras):
        return ["profile.txt"]
    columns = np.column_stack([_dlt(camera, origin) for camera in placed.values()])
    text = "\n".join(",".join(f"{value:.12g}" for value in row) for row in columns)
    write_atomically(folder / "dltCoefs.csv", text + "\n")
    return ["profile.txt", "dltCoefs.csv"]


def _dlt(camera: Camera, origin: PixelOrigin) -> Array:
    """(11,) coefficients: the projection matrix row by row, divided by its last element, without that."""
    corners = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
    there = origin.write(corners, camera.height)
    to_format = np.eye(3)
    to_format[:2, 2], to_format[:2, :2] = there[0], (there[1:] - there[0]).T
    P = to_format @ camera.K @ invert(camera.matrix())[:3]
    return (P / P[2, 3]).ravel()[:11]
