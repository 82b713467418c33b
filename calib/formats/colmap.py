# SPDX-License-Identifier: BSD-3-Clause
"""COLMAP's text format (https://colmap.github.io/format.html): `cameras.txt`, `images.txt` and an empty `points3D.txt`.

Quaternion and translation take the world into the camera. The centre of the top-left pixel is (0.5, 0.5). A rig has one
image of each camera; several images may have one lens.
"""

from collections.abc import Sequence
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from calib.errors import CalibrationError
from calib.formats.data import ForeignData, PixelOrigin, make_camera, read_text
from calib.rig.camera import Camera
from calib.rig.rig import MAX_CAMERAS, Rig
from camera_node.foundation.config import is_name, write_atomically
from camera_node.foundation.errors import ConfigError
from camera_node.geometry.pose import invert, motion_from, rotation_from_wxyz, wxyz_from_rotation

SHORT, FULL = 4, 8  # distortion coefficients of OPENCV and of FULL_OPENCV
# Of each model: whether it has two focal lengths, the number of its coefficients, and whether it is a fisheye.
MODELS = {
    "SIMPLE_PINHOLE": (False, 0, False),
    "PINHOLE": (True, 0, False),
    "SIMPLE_RADIAL": (False, 1, False),
    "RADIAL": (False, 2, False),
    "OPENCV": (True, 4, False),
    "FULL_OPENCV": (True, 8, False),
    "SIMPLE_RADIAL_FISHEYE": (False, 1, True),
    "RADIAL_FISHEYE": (False, 2, True),
    "OPENCV_FISHEYE": (True, 4, True),
}
POSE_WORDS = 10  # of a line of images.txt: number, quaternion, translation, camera, name
UNSCALED = "COLMAP's world has no scale unless it was aligned: calibrate with a wand, or give --unit-m"


def read(paths: Sequence[Path], origin: PixelOrigin) -> ForeignData:
    """Read the folder of a model in text form, or its cameras.txt and images.txt. A camera has the name of its image.

    Raises:
        ConfigError, CalibrationError: a file is neither, or has impossible values.
    """
    origin.require_opencv("COLMAP")
    folder = paths[0] if paths[0].is_dir() else None
    files = [folder / "cameras.txt", folder / "images.txt"] if folder else list(paths)
    by_name = {path.name: path for path in files if path.exists()}
    if "cameras.txt" not in by_name:
        raise ConfigError(
            f"{paths[0]} has no cameras.txt; colmap model_converter --output_type TXT writes it from cameras.bin"
        )
    lenses = _read_lenses(by_name["cameras.txt"])
    placed = _read_images(by_name["images.txt"], lenses) if "images.txt" in by_name else {}
    if not placed:
        return ForeignData({f"cam{number}": make_camera(*lens) for number, lens in lenses.items()})
    return ForeignData(placed, remarks=(UNSCALED,))


def _rows(path: Path) -> list[list[str]]:
    return [line.split() for line in read_text(path).splitlines() if not line.startswith("#")]


def _read_lenses(path: Path) -> dict[str, tuple[Any, Any, Any, Any, Any]]:
    """Size, focal lengths, centre, coefficients and kind of each lens, by its number."""
    lenses = {}
    for row in filter(None, _rows(path)):
        where = f"{path}: camera {row[0][:20]}"
        if len(row) < 4 or row[1] not in MODELS:
            raise ConfigError(f"{where}: its model can't be imported; {', '.join(MODELS)} can")
        two, count, is_fisheye = MODELS[row[1]]
        try:
            width, height, *numbers = (float(word) for word in row[2:])
            focal, rest = (numbers[:2], numbers[2:]) if two else (numbers[:1] * 2, numbers[1:])
            (cx, cy), coefficients = rest[:2], rest[2:]
        except ValueError:
            raise ConfigError(f"{where}: its parameters are not numbers, or too few") from None
        if len(coefficients) != count:
            raise ConfigError(f"{where}: {row[1]} has {count} coefficients, not {len(coefficients)}")
        padded = (*coefficients, *[0.0] * (SHORT - count)) if count else ()
        lenses[row[0]] = (width, height), focal, (cx - 0.5, cy - 0.5), padded, is_fisheye
    return lenses


def _read_images(path: Path, lenses: dict[str, tuple[Any, Any, Any, Any, Any]]) -> dict[str, Camera]:
    """A camera of each image; every second line has the image's points, and may be empty."""
    cameras: dict[str, Camera] = {}
    for row in filter(None, _rows(path)[::2]):
        if len(row) < POSE_WORDS or row[8] not in lenses:
            raise ConfigError(f"{path}: image {row[0][:20]} has no pose, or a camera that cameras.txt lacks")
        name = PurePosixPath(row[9]).stem
        if not is_name(name) or name in cameras or len(cameras) >= MAX_CAMERAS:
            raise ConfigError(
                f"{path}: image '{row[9][:40]}' can't name a camera of a rig; keep one image of each camera, with "
                "its name, such as north.png"
            )
        try:
            numbers = np.array([float(word) for word in row[1:8]])
        except ValueError:
            raise ConfigError(f"{path}: the pose of image '{row[9][:40]}' is not numbers") from None
        if not (np.isfinite(numbers).all() and np.linalg.norm(numbers[:4]) > 0):
            raise ConfigError(f"{path}: the pose of image '{row[9][:40]}' is not finite")
        T = motion_from(rotation_from_wxyz(numbers[:4] / np.linalg.norm(numbers[:4])), numbers[4:])
        cameras[name] = make_camera(*lenses[row[8]], T)
    return cameras


def write(rig: Rig, folder: Path, origin: PixelOrigin) -> list[str]:
    """Write the model; images are named `<camera>.png`. Returns the names of the files.

    Raises:
        CalibrationError: a lens has more coefficients than COLMAP's models, or the pixel origin is not OpenCV's.
    """
    origin.require_opencv("COLMAP")
    cameras, images = [], []
    for number, (name, camera) in enumerate(rig.cameras.items(), 1):
        model, distortion = _model(name, camera)
        parameters = [camera.fx, camera.fy, camera.cx + 0.5, camera.cy + 0.5, *distortion]
        cameras.append(f"{number} {model} {camera.width} {camera.height} {_join(parameters)}\n")
        if camera.T_world_cam is not None:
            T = invert(camera.matrix())
            pose = [*wxyz_from_rotation(T[:3, :3]).tolist(), *T[:3, 3].tolist()]
            images.append(f"{number} {_join(pose)} {number} {name}.png\n\n")
    files = {
        "cameras.txt": "# CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]\n" + "".join(cameras),
        "images.txt": "# IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME\n" + "".join(images),
        "points3D.txt": "# POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[]\n",
    }
    for file, text in files.items():
        write_atomically(folder / file, text)
    return list(files)


def _model(name: str, camera: Camera) -> tuple[str, tuple[float, ...]]:
    if camera.model == "fisheye":
        return "OPENCV_FISHEYE", camera.distortion or (0.0,) * SHORT
    padded = (*camera.distortion, *[0.0] * FULL)
    if any(padded[FULL:]):
        raise CalibrationError(
            f"camera '{name}': COLMAP has no lens with {len(camera.distortion)} coefficients"
        )
    return ("FULL_OPENCV", padded[:FULL]) if any(padded[SHORT:]) else ("OPENCV", padded[:SHORT])


def _join(values: list[float]) -> str:
    return " ".join(f"{value:.12g}" for value in values)
