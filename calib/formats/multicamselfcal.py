# SPDX-License-Identifier: BSD-3-Clause
"""MultiCamSelfCal (Svoboda, Martinec and Pajdla 2005): a folder with points, image sizes, lenses and projections.

`points.dat`: 3 C rows of homogeneous pixels (u, v, 1) of C cameras, one column a frame. `IdMat.dat`: C rows, 1 where a
camera saw the light. `Res.dat`: width and height of each camera. `camera_order.txt`: their names, where flydra wrote
one. `*.rad`, one a camera: `K11 = ...` to `K33` and `kc1` to `kc4`, OpenCV's k1, k2, p1, p2 (CalTechCal/goradf.m of
strawlab/MultiCamSelfCal). `*.cal`, one a camera: the 3 x 4 matrix to undistorted pixels.
"""

import re
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from calib.errors import CalibrationError
from calib.formats.data import (
    ForeignData,
    PixelOrigin,
    PointTable,
    make_camera,
    read_numbers,
    read_text,
    with_coefficients,
)
from calib.rig.camera import Camera
from calib.rig.rig import Rig
from camera_node.foundation.arrays import Array
from camera_node.foundation.config import require_name, write_atomically
from camera_node.foundation.errors import ConfigError
from camera_node.geometry.pose import Pose, invert

FROM_ZERO = PixelOrigin(0)
ENTRY = re.compile(r"\s*(K[123][123]|kc[1-4])\s*=\s*(\S+)\s*")
CAL_SHAPE, COEFFICIENTS = (3, 4), 4


def read(paths: Sequence[Path], origin: PixelOrigin) -> ForeignData:
    """Read the folder of a calibration; any of the files may be missing, but not the image sizes of lenses.

    Raises:
        ConfigError, CalibrationError: the files don't fit each other, or have impossible values.
    """
    if len(paths) != 1 or not paths[0].is_dir():
        raise ConfigError("give the one folder that contains points.dat, IdMat.dat, Res.dat, *.rad or *.cal")
    files = {path.name.lower(): path for path in sorted(paths[0].iterdir()) if path.is_file()}
    rad = _sort_numbered([path for path in files.values() if path.suffix == ".rad"])
    cal = _sort_numbered([path for path in files.values() if path.suffix == ".cal"])
    points = _read_matrix(files.get("points.dat"))
    count = len(points) // 3 if points is not None else len(rad) or len(cal)
    names = _read_names(files.get("camera_order.txt"), count)
    sizes = _read_matrix(files.get("res.dat"))
    if rad or cal:
        _require(
            sizes is not None and sizes.shape == (count, 2),
            f"Res.dat must have {count} rows of width and height",
        )
    _require(not rad or len(rad) == count, f"{len(rad)} .rad files of {count} cameras")
    _require(not cal or len(cal) == count, f"{len(cal)} .cal files of {count} cameras")
    lenses = [_read_rad(path) for path in rad] or [None] * len(cal)
    cameras = {}
    for k, lens in enumerate(lenses):
        assert sizes is not None
        cameras[names[k]] = _build(lens, _read_cal(cal[k]) if cal else None, sizes[k], origin)
    table = (
        _collect(points, _read_matrix(files.get("idmat.dat")), names, origin) if points is not None else None
    )
    return ForeignData(cameras, table)


def _require(condition: bool, fault: str) -> None:
    if not condition:
        raise ConfigError(f"these files don't belong together: {fault}")


def _sort_numbered(paths: Sequence[Path]) -> list[Path]:
    """Paths by the last number in their names: camera 10 after camera 9."""
    return sorted(paths, key=lambda path: ([int(n) for n in re.findall(r"\d+", path.name)][-1:], path.name))


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


def _read_rad(path: Path) -> dict[str, float]:
    values = {}
    for line in read_text(path).splitlines():
        if match := ENTRY.fullmatch(line):
            try:
                values[match[1]] = float(match[2])
            except ValueError:
                raise ConfigError(f"{path}: '{line[:60]}' is not a number") from None
    if missing := {"K11", "K13", "K22", "K23"} - set(values):
        raise ConfigError(f"{path} lacks {', '.join(sorted(missing))}")
    return values


def _read_cal(path: Path) -> Array:
    P = _read_matrix(path)
    if P is None or P.shape != CAL_SHAPE:
        raise ConfigError(f"{path} is not a matrix of 3 x 4 numbers")
    return P


def _build(lens: dict[str, float] | None, P: Array | None, size: Array, origin: PixelOrigin) -> Camera:
    """A camera from its `.rad`, else from the calibration matrix of its projection; with the pose of this."""
    K, pose = (None, None) if P is None else _decompose(P)
    if lens is not None:
        K = np.array([[lens["K11"], 0, lens["K13"]], [0, lens["K22"], lens["K23"]]])
    assert K is not None
    centre = origin.read(K[None, :2, 2])[0]
    return make_camera(
        width=size[0],
        height=size[1],
        fx=float(K[0, 0]),
        fy=float(K[1, 1]),
        cx=float(centre[0]),
        cy=float(centre[1]),
        distortion=tuple(lens.get(f"kc{k}", 0.0) for k in range(1, 5)) if lens else (),
        T_world_cam=pose,
    )


def _decompose(P: Array) -> tuple[Array, Pose]:
    """The (3, 3) calibration matrix and the pose of a (3, 4) projection matrix of any scale and sign."""
    if not np.isfinite(P).all() or abs(np.linalg.det(P[:, :3])) < 1e-12:
        raise CalibrationError("a .cal file has no projection of a camera at a finite place")
    K, R, centre = cv2.decomposeProjectionMatrix(P * np.sign(np.linalg.det(P[:, :3])))[:3]
    signs = np.diag(np.sign(np.diag(K)))  # RQ decomposition is unique up to the signs of the diagonal
    T = np.eye(4)
    T[:3, :3] = (signs @ R).T
    T[:3, 3] = (centre[:3] / centre[3]).ravel()
    return K @ signs / abs(K[2, 2]), Pose.from_matrix(T)


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
