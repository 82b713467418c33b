# SPDX-License-Identifier: BSD-3-Clause
"""Argus, easyWand and DLTdv: camera profiles, tables of points (`xypts.csv`) and DLT coefficients.

Profile: one row a camera, separated by spaces or commas. easyWand: number, focal length (px), width, height, cx, cy,
aspect ratio fy / fx; Argus Clicker adds r2, r4, t1, t2, r6, which are OpenCV's k1, k2, p1, p2, k3 (Argus user guide,
section "Wand", kilmoretrout/argus_gui docs/user-guide.md; easyWand: RGBsetup_profile.txt of PeppyHare/EasyWand).
Points: columns `pt1_cam1_X, pt1_cam1_Y, pt1_cam2_X, ...`, NaN where a camera did not see a point, row k is frame k; the
wand tables of easyWand have the same columns without names. DLTdv8 counts pixels from 1 at the top left, DLTdv5 to 7
and Argus from 1 at the bottom left (tlhedrick/dltdv). DLT coefficients: `dltCoefs.csv`, 11 rows, one column a camera:
the world to undistorted pixels; they tell the direction of y, because worlds are right-handed.

easyWand saves `*_easyWandData.mat`: a struct with imageWidth, imageHeight, focalLengths, ppts (or principalPoints),
nlin, wandPts, wandLen and coefs (easyWand5.m, saveResultsButton_callback).
"""

import csv
import io
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from calib.errors import CalibrationError
from calib.formats.data import (
    MAX_FILE_BYTES,
    MAX_OFF_PX,
    ForeignData,
    PixelOrigin,
    PointTable,
    make_camera,
    place_by_projection,
    read_numbers,
    read_text,
)
from calib.rig.camera import Camera
from calib.rig.rig import Rig
from calib.rig.wand_file import WandBody
from camera_node.foundation.arrays import Array, Index
from camera_node.foundation.config import write_atomically
from camera_node.foundation.errors import ConfigError
from camera_node.geometry.pose import invert

COLUMN = re.compile(r"\s*pt(\d+)_cam(\d+)_([xy])\s*", re.IGNORECASE)
COEFFICIENTS = 11
ASK = (
    "y is counted from the top row, as DLTdv8 and easyWand do: for tables of DLTdv 5 to 7 give --y-up, or "
    "dltCoefs.csv, which tells it"
)
EASYWAND_COLUMNS, CLICKER_COLUMNS, SBA_COLUMNS = 7, 12, 17
MAX_NUMBER = 10_000  # of a point or a camera in a column's name


def read(paths: Sequence[Path], origin: PixelOrigin) -> ForeignData:
    """Read a camera profile, a table of points, DLT coefficients, or the `.mat` of easyWand, which has all of them.
    Cameras are named cam1, cam2, ...

    Raises:
        ConfigError, CalibrationError: a file is neither, or has impossible values.
    """
    if saved := [path for path in paths if path.suffix.lower() == ".mat"]:
        if len(paths) > 1:
            raise ConfigError(f"{saved[0]} has cameras and points; give no other file")
        return _read_saved(saved[0], origin)
    tables = [path for path in paths if path.suffix.lower() == ".csv"]
    coefficients = [path for path in tables if "dlt" in path.stem.lower()]
    tables = [path for path in tables if path not in coefficients]
    cameras: dict[str, Camera] = {}
    for path in paths:
        if path not in tables and path not in coefficients:
            cameras |= _read_profile(path)
    if len(tables) > 1:
        raise ConfigError(
            f"{len(tables)} tables of points; import one after the other, each with its own --out"
        )
    remarks: tuple[str, ...] = ()
    if coefficients:
        cameras, origin, remarks = _place(cameras, _read_coefficients(coefficients[0], cameras), origin)
    elif tables and not origin.y_up:
        remarks = (ASK,)
    points = _read_points(tables[0], cameras, origin) if tables else None
    return ForeignData(cameras, points, remarks=remarks)


def _read_coefficients(path: Path, cameras: Mapping[str, Camera]) -> Array:
    """(C, 3, 4) projection matrices."""
    rows = read_numbers(path)
    if len(rows) != COEFFICIENTS or any(len(row) != len(cameras) for row in rows):
        raise ConfigError(
            f"{path} needs {COEFFICIENTS} rows of {len(cameras)} numbers, one column for each camera of the profile"
        )
    return _projections(np.array(rows))


def _projections(coefficients: Array) -> Array:
    """(C, 3, 4) projection matrices from (11, C) coefficients."""
    return np.vstack([coefficients, np.ones(coefficients.shape[1])]).T.reshape(-1, 3, 4)


def _place(
    cameras: Mapping[str, Camera], P: Array, origin: PixelOrigin
) -> tuple[dict[str, Camera], PixelOrigin, tuple[str, ...]]:
    """The cameras at the poses of their projections (C, 3, 4), and the origin with the direction of y that these show.

    A projection is from a right-handed world: its determinant is negative where y is counted upwards.
    """
    up = int((np.linalg.det(P[:, :, :3]) < 0).sum())
    if up not in (0, len(P)):
        raise CalibrationError("the DLT coefficients of some cameras are mirrored against those of others")
    found = PixelOrigin(origin.first, y_up=up > 0)
    placed = {}
    for (name, camera), projection in zip(cameras.items(), P, strict=True):
        P_zero = np.linalg.inv(found.matrix(camera.height)) @ projection
        placed[name], off = place_by_projection(camera, P_zero, f"the DLT coefficients of '{name}'")
        if off > MAX_OFF_PX:
            raise CalibrationError(
                f"the lens and the DLT coefficients of camera '{name}' differ by up to {off:.0f} px; give the profile "
                "that belongs to them"
            )
    which = "the lowest" if found.y_up else "the top"
    changed = found.y_up != origin.y_up
    return placed, found, (f"the DLT coefficients count y from {which} row",) if changed else ()


def _read_saved(path: Path, origin: PixelOrigin) -> ForeignData:
    """The cameras, poses, points and wand of a `.mat` file of easyWand."""
    saved = _load_matlab(path)
    try:
        focal = np.ravel(np.asarray(saved.focalLengths, float))
        centres = np.asarray(getattr(saved, "ppts", getattr(saved, "principalPoints", None)), float).reshape(
            -1, 2
        )
        width, height = (
            np.broadcast_to(np.ravel(np.asarray(value, float)), len(focal))
            for value in (saved.imageWidth, saved.imageHeight)
        )
        distortion = np.asarray(getattr(saved, "nlin", np.zeros((len(focal), 0))), float).reshape(
            len(focal), -1
        )
        table = np.asarray(saved.wandPts, float).reshape(-1, 4 * len(focal))
        coefficients = np.asarray(getattr(saved, "coefs", np.zeros((0, 0))), float)
        length = float(saved.wandLen)
    except (AttributeError, TypeError, ValueError) as error:
        raise ConfigError(
            f"{path} is not a result of easyWand: {error}; import its profile and tables"
        ) from None
    if len(centres) != len(focal) or distortion.shape[1] not in (0, 5):
        raise ConfigError(f"{path}: focalLengths, ppts and nlin are not of the same cameras; save it again")
    cameras = {}
    for k, f in enumerate(focal.tolist(), 1):
        size = width[k - 1], height[k - 1]
        cameras[f"cam{k}"] = make_camera(size, (f, f), centres[k - 1], distortion[k - 1])
    remarks: tuple[str, ...] = () if origin.y_up else (ASK,)
    if coefficients.shape == (COEFFICIENTS, len(focal)) and np.isfinite(coefficients).all():
        cameras, origin, remarks = _place(cameras, _projections(coefficients), origin)
    try:
        wand = WandBody(markers=((0.0, 0.0, 0.0), (length, 0.0, 0.0)))
    except ValueError as error:
        raise CalibrationError(f"{path}: wandLen: {error}") from None
    points = _collect(table, _number_columns(path, table.shape[1], len(cameras)), cameras, origin)
    return ForeignData(cameras, points, wand, remarks)


def _load_matlab(path: Path) -> Any:
    """The struct easyWandData.

    Raises:
        ConfigError: the file is no such file of MATLAB, or one of version 7.3.
    """
    from scipy.io import loadmat

    try:
        if path.stat().st_size > MAX_FILE_BYTES:
            raise ConfigError(f"{path} has more than {MAX_FILE_BYTES} bytes; is it the right file?")
        found = loadmat(
            path, squeeze_me=True, struct_as_record=False, variable_names=["easyWandData"], appendmat=False
        )
        return found["easyWandData"]
    except ConfigError:
        raise
    except NotImplementedError:
        raise ConfigError(f"{path} is of version 7.3 of MATLAB's format; save it with save -v7") from None
    except OSError as error:
        raise ConfigError(f"{path} can't be read: {error.strerror}; check the path") from None
    except Exception as error:  # scipy raises whatever a damaged file leads to
        raise ConfigError(
            f"{path} is not a result of easyWand: {type(error).__name__}; save it again"
        ) from None


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
        lens = (width, height), (focal, focal * ratio), (cx, cy), distortion
        cameras[f"cam{number:g}"] = make_camera(*lens)
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
    P = origin.matrix(camera.height) @ camera.K @ invert(camera.matrix())[:3]
    return (P / P[2, 3]).ravel()[:11]
