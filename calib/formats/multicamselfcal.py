# SPDX-License-Identifier: BSD-3-Clause
"""MultiCamSelfCal (Svoboda, Martinec and Pajdla 2005): a folder with points, image sizes, lenses and projections.

Input: `points.dat`, 3 C rows of homogeneous pixels (u, v, 1) of C cameras, one column a frame; `IdMat.dat`, C rows, 1
where a camera saw the light. Result: `cam<k>.points4cal.dat`, one row a point that was used, with the homogeneous point
and pixel; the rows of one frame have equal points. `Res.dat`: width and height of each camera. `camera_order.txt`:
their names, where flydra wrote one; `calibration_units.txt`, the unit of the world.

`*.rad`, one a camera: `K11 = ...` to `K33` and `kc1` to `kc4`, OpenCV's k1, k2, p1, p2 (CalTechCal/goradf.m of
strawlab/MultiCamSelfCal): they undistort. `*.Pmat.cal`: the 3 x 4 matrix to undistorted pixels, whose calibration
matrix is another one. `basename<k>.cal` has the same projection rounded: the centre `C1 = ...` to `C3`, and `P11` to
`P33`, which takes undistorted pixels to directions; it is used where the matrix is missing.
"""

import re
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from calib.errors import CalibrationError
from calib.formats.data import (
    MAX_OFF_PX,
    ForeignData,
    PixelOrigin,
    PointTable,
    make_camera,
    place_by_projection,
    read_numbers,
    read_text,
    with_coefficients,
)
from calib.rig.camera import Camera
from calib.rig.rig import Rig
from calib.rig.wand_file import WandBody
from camera_node.foundation.arrays import Array
from camera_node.foundation.config import require_name, write_atomically
from camera_node.foundation.errors import ConfigError
from camera_node.geometry.pose import invert

ENTRY = re.compile(r"\s*([A-Za-z]+\d+)\s*=\s*([^\s;]+)\s*;?\s*")
CAL_SHAPE, POINT_COLUMNS, COEFFICIENTS = (3, 4), 7, 4
METRES = {"millimeters": 1e-3, "mm": 1e-3, "centimeters": 1e-2, "cm": 1e-2, "meters": 1.0, "m": 1.0}
LIGHT = WandBody(markers=((0.0, 0.0, 0.0),))


def read(paths: Sequence[Path], origin: PixelOrigin) -> ForeignData:
    """Read the folder of a calibration; any of the files may be missing, but not the image sizes of lenses.

    Raises:
        ConfigError, CalibrationError: the files don't fit each other, or have impossible values.
    """
    if len(paths) != 1 or not paths[0].is_dir():
        raise ConfigError("give the one folder that contains points.dat, IdMat.dat, Res.dat, *.rad or *.cal")
    files = {path.name.lower(): path for path in sorted(paths[0].iterdir()) if path.is_file()}
    rad, cal, seen = (_sort_numbered(files, end) for end in (".rad", ".pmat.cal", ".points4cal.dat"))
    cal = cal or _sort_numbered(files, ".cal")
    points = _read_matrix(files.get("points.dat"))
    count = len(points) // 3 if points is not None else len(rad) or len(cal) or len(seen)
    names = _read_names(files.get("camera_order.txt"), count)
    sizes = _read_matrix(files.get("res.dat"))
    if rad or cal:
        _require(
            sizes is not None and sizes.shape == (count, 2),
            f"Res.dat must have {count} rows of width and height",
        )
    for kind, found in ((".rad", rad), (".cal", cal), (".points4cal.dat", seen if points is None else ())):
        _require(not found or len(found) == count, f"{len(found)} {kind} files of {count} cameras")
    unit_m = _read_unit(files.get("calibration_units.txt"))
    cameras, remarks = {}, []
    for k, name in enumerate(names if sizes is not None and (rad or cal) else ()):
        assert sizes is not None
        P = _read_cal(cal[k], unit_m) if cal else None
        cameras[name], off = _build(name, rad[k] if rad else None, P, sizes[k], origin)
        if off > MAX_OFF_PX:
            remarks.append(
                f"camera '{name}': its .rad and .cal files together are no lens of OpenCV's model; the nearest one "
                f"differs by up to {off:.1f} px, which roundel calibrate wand corrects"
            )
    table = None
    if points is not None:
        table = _collect(points, _read_matrix(files.get("idmat.dat")), names, origin)
    elif seen:
        table = _collect_used(seen, names, origin)
    return ForeignData(cameras, table, LIGHT if table else None, tuple(remarks))


def _require(condition: bool, fault: str) -> None:
    if not condition:
        raise ConfigError(f"these files don't belong together: {fault}")


def _sort_numbered(files: Mapping[str, Path], end: str) -> list[Path]:
    """Paths whose names have this end, by the last number before it: camera 10 after camera 9."""
    chosen = [(re.findall(r"\d+", name[: -len(end)])[-1:], name) for name in files if name.endswith(end)]
    return [files[name] for _, name in sorted(chosen, key=lambda pair: ([int(n) for n in pair[0]], pair[1]))]


def _read_matrix(path: Path | None) -> Array | None:
    if path is None:
        return None
    rows = read_numbers(path)
    if not rows or len({len(row) for row in rows}) != 1:
        raise ConfigError(f"{path} is not a matrix: its rows have different lengths, or there are none")
    return np.array(rows)


def _read_names(path: Path | None, count: int) -> list[str]:
    if path is None:
        return [f"cam{k}" for k in range(1, count + 1)]
    names = [require_name(line.strip(), "a camera") for line in read_text(path).splitlines() if line.strip()]
    _require(
        len(names) == count == len(set(names)),
        f"{path.name} names {len(names)} cameras, the others have {count}",
    )
    return names


def _read_unit(path: Path | None) -> float:
    """Metres of one unit of the world; 1 where no file states it."""
    if path is None:
        return 1.0
    unit = read_text(path).strip().lower().replace("metre", "meter")
    if unit not in METRES:
        raise ConfigError(f"{path}: the unit '{unit[:40]}' is unknown; write one of {', '.join(METRES)}")
    return METRES[unit]


def _read_entries(path: Path, needed: Sequence[str]) -> dict[str, float]:
    """The numbers of a file of lines `name = number`.

    Raises:
        ConfigError: a needed one is missing, or one is not a finite number.
    """
    values = {}
    for line in read_text(path).splitlines():
        if match := ENTRY.fullmatch(line):
            try:
                values[match[1]] = float(match[2])
            except ValueError:
                raise ConfigError(f"{path}: '{line[:60]}' is not a number") from None
    if missing := [name for name in needed if not np.isfinite(values.get(name, np.nan))]:
        raise ConfigError(f"{path} lacks {', '.join(missing)}; copy the file again")
    return values


def _read_cal(path: Path, unit_m: float) -> Array:
    """(3, 4) the projection matrix from metres."""
    if "=" in read_text(path)[:1000]:
        grid = [f"P{row}{column}" for row in range(1, 4) for column in range(1, 4)]
        values = _read_entries(path, ["C1", "C2", "C3", *grid])
        directions = np.array([values[name] for name in grid]).reshape(3, 3)
        if not abs(np.linalg.det(directions)) > 0:
            raise CalibrationError(f"{path} has no projection of a camera at a finite place")
        M = np.linalg.inv(directions)
        P = np.column_stack([M, -M @ [values["C1"], values["C2"], values["C3"]]])
    else:
        matrix = _read_matrix(path)
        if matrix is None or matrix.shape != CAL_SHAPE:
            raise ConfigError(f"{path} is not a matrix of 3 x 4 numbers")
        P = matrix
    return P @ np.diag([1 / unit_m, 1 / unit_m, 1 / unit_m, 1.0])


def _build(
    name: str, rad: Path | None, P: Array | None, size: Array, origin: PixelOrigin
) -> tuple[Camera, float]:
    """A camera from its `.rad` and its projection, of which one may be missing, and how far its pixels are off."""
    P = None if P is None else np.linalg.inv(origin.matrix(int(size[1]))) @ P
    if rad is None:
        assert P is not None
        bare = make_camera(size, (1.0, 1.0), (0.0, 0.0))
        return place_by_projection(bare, P, f"the .cal file of '{name}'")
    lens = _read_entries(rad, ["K11", "K13", "K22", "K23"])
    centre = origin.read(np.array([[lens["K13"], lens["K23"]]]))[0]
    shape = [lens.get(f"kc{k}", 0.0) for k in range(1, 5)]
    camera = make_camera(size, (lens["K11"], lens["K22"]), centre, shape)
    return (camera, 0.0) if P is None else place_by_projection(camera, P, f"the .cal file of '{name}'")


def _collect(points: Array, seen: Array | None, names: Sequence[str], origin: PixelOrigin) -> PointTable:
    _require(len(points) == 3 * len(names), "points.dat must have three rows for each camera")
    stacked = points.reshape(len(names), 3, -1)
    known = np.isfinite(stacked[:, :2]).all(axis=1)
    if seen is not None:
        _require(seen.shape == known.shape, f"IdMat.dat has {seen.shape}, points.dat is for {known.shape}")
        known &= seen > 0
    camera, frame = np.nonzero(known)
    if not len(camera):
        raise CalibrationError("points.dat has no points")
    uv = origin.read(stacked[camera, :2, frame])
    return PointTable([names[k] for k in camera.tolist()], frame, np.zeros(len(frame), np.intp), uv)


def _collect_used(paths: Sequence[Path], names: Sequence[str], origin: PixelOrigin) -> PointTable:
    """The points that the calibration used. Frames have lost their numbers: they are numbered in their order."""
    tables = []
    for path in paths:
        table = _read_matrix(path)
        if table is None or table.shape[1] != POINT_COLUMNS or not np.isfinite(table).all():
            raise ConfigError(
                f"{path} needs {POINT_COLUMNS} finite numbers a row: a homogeneous point and a pixel"
            )
        tables.append(table)
    frames: dict[tuple[float, ...], int] = {}
    for table in sorted(tables, key=len, reverse=True):
        for point in map(tuple, table[:, :3].tolist()):
            frames.setdefault(point, len(frames))
    camera = [name for name, table in zip(names, tables, strict=True) for _ in range(len(table))]
    stacked = np.concatenate(tables)
    frame = np.array([frames[point] for point in map(tuple, stacked[:, :3].tolist())], np.intp)
    uv = origin.read(stacked[:, 4:6] / stacked[:, 6:])
    return PointTable(camera, frame, np.zeros(len(frame), np.intp), uv)


def write(rig: Rig, folder: Path, origin: PixelOrigin) -> list[str]:
    """Write `camera_order.txt`, `Res.dat`, `basename<k>.rad` and, with poses, `camera<k>.Pmat.cal`; return their names.

    Raises:
        CalibrationError: a lens can't be expressed with k1, k2, p1, p2.
    """
    files = {"camera_order.txt": "\n".join(rig.cameras) + "\n"}
    files["Res.dat"] = "".join(f"{c.width} {c.height}\n" for c in rig.cameras.values())
    for number, (name, camera) in enumerate(rig.cameras.items(), 1):
        if camera.model != "pinhole":
            raise CalibrationError(f"camera '{name}': .rad files have pinhole lenses only")
        lens = with_coefficients(name, camera, COEFFICIENTS)[0]
        K = lens.K.copy()
        K[:2, 2] = origin.write(K[None, :2, 2])[0]
        entries = [f"K{i + 1}{j + 1} = {K[i, j]:.16g}" for i in range(3) for j in range(3)]
        entries += [f"kc{k} = {value:.16g}" for k, value in enumerate(lens.distortion, 1)]
        files[f"basename{number}.rad"] = "\n".join(entries) + "\n"
        if camera.T_world_cam is not None:
            P = K @ invert(camera.matrix())[:3]
            files[f"camera{number}.Pmat.cal"] = "".join(
                " ".join(f"{x:.16g}" for x in row) + "\n" for row in P
            )
    for file, text in files.items():
        write_atomically(folder / file, text)
    return list(files)
