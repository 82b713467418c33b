# SPDX-License-Identifier: BSD-3-Clause
"""OpenCV's camera files (YAML of `cv::FileStorage`) and ROS's `camera_info`, one file a camera; and OpenCV's multi-view
calibration, one file for all.

Matrices are mappings with rows, cols and data, with or without the tag `!!opencv-matrix`. Names: camera_matrix (also
cameraMatrix, K, M1), distortion_coefficients (also distCoeffs, D), image_width and image_height (also image_size), and
in ROS camera_name and distortion_model (samples/cpp/calibration.cpp of OpenCV; camera_calibration_parsers of ROS). A
message that `rostopic echo` or `ros2 topic echo` prints has K and D, or k and d, as lists.

Multi-view (samples/python/multiview_calibration.py of OpenCV 5): Ks (C, 3, 3), distortions (C, n), rvecs and Ts (C, 3)
from the first camera into each, image_sizes (C, 2), is_fisheye (C,) and cam_ids, names with commas.
"""

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from calib.formats.data import ForeignData, PixelOrigin, make_camera, read_text
from calib.rig.camera import Camera
from calib.rig.rig import Rig
from camera_node.foundation.config import is_name, parse_yaml, read_yaml, write_atomically
from camera_node.foundation.errors import ConfigError
from camera_node.geometry.pose import invert, motion_from

MULTIVIEW = ("Ks", "distortions", "rvecs", "Ts", "image_sizes", "is_fisheye", "cam_ids")
BLOCK = re.compile(r"^(\w+):.*\n(?:[ \t].*\n|\n)*", re.MULTILINE)
MATRIX = ("camera_matrix", "cameraMatrix", "Camera_Matrix", "K", "k", "M", "M1", "intrinsic_matrix")
DISTORTION = (
    "distortion_coefficients",
    "distCoeffs",
    "dist_coeffs",
    "Distortion_Coefficients",
    "D",
    "d",
    "D1",
)
FISHEYE = ("fisheye", "equidistant")
PINHOLE = ("", "plumb_bob", "rational_polynomial", "pinhole")


def read(paths: Sequence[Path], origin: PixelOrigin) -> ForeignData:
    """Read one camera from each file; it has the name that the file states, else that of the file. A file of a
    multi-view calibration has all cameras.

    Raises:
        ConfigError, CalibrationError: a file is not such a file, or has impossible values.
    """
    cameras = {}
    for path in paths:
        if (blocks := _multiview_blocks(read_text(path))) is not None:
            cameras |= _read_multiview(path, parse_yaml(blocks.encode(), path, foreign=True))
            continue
        data = read_yaml(path, foreign=True)
        if not isinstance(data, Mapping):
            raise ConfigError(f"{path} is not a camera file of OpenCV or ROS")
        stated = str(data.get("camera_name", ""))
        name = stated if is_name(stated) else path.stem
        if name in cameras:
            raise ConfigError(f"{path}: camera '{name}' was already in another file; rename one")
        cameras[name] = _build(path, data, origin)
    return ForeignData(cameras)


def _multiview_blocks(text: str) -> str | None:
    """The part of a file of a multi-view calibration that has the cameras; None of another file."""
    blocks = {match[1]: match[0] for match in BLOCK.finditer(text + "\n") if match[1] in MULTIVIEW}
    return "".join(blocks.values()) if "Ks" in blocks else None


def _read_multiview(path: Path, data: Any) -> dict[str, Camera]:
    names = [name.strip() for name in str(data.get("cam_ids", "")).split(",") if name.strip()]
    arrays = {}
    for key in MULTIVIEW[:-1]:
        value = data.get(key)
        try:
            numbers = value["data"] if isinstance(value, Mapping) else value
            arrays[key] = np.array([float(number) for number in numbers])
        except (KeyError, TypeError, ValueError):
            raise ConfigError(
                f"{path} lacks the matrix {key}, or it is not numbers; write the file again"
            ) from None
    count = len(arrays["Ks"]) // 9
    if not count or any(not len(a) or len(a) % count for a in arrays.values()):
        raise ConfigError(
            f"{path}: its matrices are not those of one number of cameras; write the file again"
        )
    K, distortions, turns, shifts, sizes, fisheye = (a.reshape(count, -1) for a in arrays.values())
    if turns.shape[1] != 3 or shifts.shape[1] != 3 or sizes.shape[1] != 2:
        raise ConfigError(f"{path}: rvecs and Ts need 3 numbers a camera, and image_sizes 2")
    if not all(np.isfinite(a).all() for a in arrays.values()):
        raise ConfigError(f"{path}: a number is not finite; calibrate again")
    if len(names) != count or len(set(names)) != count:
        names = [f"cam{k}" for k in range(count)]
    cameras = {}
    for k, name in enumerate(names):
        of_model = distortions[k][:4] if fisheye[k, 0] else distortions[k]
        lens = sizes[k], K[k][[0, 4]], K[k][[2, 5]], of_model, bool(fisheye[k, 0])
        cameras[name] = make_camera(*lens, motion_from(turns[k], shifts[k]))
    return cameras


def _build(path: Path, data: Mapping[str, Any], origin: PixelOrigin) -> Camera:
    K = _matrix(path, data, MATRIX).reshape(3, 3)
    model = str(data.get("distortion_model") or data.get("model") or "")
    if model not in FISHEYE + PINHOLE:
        raise ConfigError(
            f"{path}: can't import the distortion model '{model[:40]}', but plumb_bob and equidistant"
        )
    fisheye = model in FISHEYE or bool(data.get("fisheye_model", 0))
    centre, distortion = origin.read(K[None, :2, 2])[0], _matrix(path, data, DISTORTION)
    return make_camera(_size(path, data), np.diag(K)[:2], centre, distortion, fisheye)


def _matrix(path: Path, data: Mapping[str, Any], names: Sequence[str]) -> np.ndarray:
    """The numbers of the first matrix of one of these names; of a camera matrix nine, of distortion any."""
    for name in names:
        if (value := data.get(name)) is not None:
            numbers = value.get("data") if isinstance(value, Mapping) else value
            try:
                found = np.ravel(np.asarray(numbers, float))
            except (TypeError, ValueError):
                break
            if names is DISTORTION or len(found) == 9:
                return found
    if names is DISTORTION:
        return np.zeros(0)
    raise ConfigError(f"{path} has no 3 x 3 camera_matrix")


def _size(path: Path, data: Mapping[str, Any]) -> tuple[float, float]:
    pairs = [
        (data.get("image_width"), data.get("image_height")),
        data.get("image_size"),
        data.get("imageSize"),
    ]
    pairs += [(data.get("image_Width"), data.get("image_Height")), (data.get("width"), data.get("height"))]
    for pair in pairs:
        match pair.get("data") if isinstance(pair, Mapping) else pair:
            case [int() | float() as width, int() | float() as height]:
                return width, height
    raise ConfigError(f"{path} has no image size; add the lines image_width and image_height")


def write(rig: Rig, folder: Path, origin: PixelOrigin) -> list[str]:
    """Write `<camera>.yaml` for each camera, with R and T from the world to the camera where it has a pose.

    Raises:
        CalibrationError: the pixel origin is another than OpenCV's.
    """
    origin.require_opencv("ROS")
    for name, camera in rig.cameras.items():
        write_atomically(folder / f"{name}.yaml", _dump(name, camera))
    return [f"{name}.yaml" for name in rig.cameras]


def _dump(name: str, camera: Camera) -> str:
    storage = cv2.FileStorage(
        "", cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY | cv2.FILE_STORAGE_FORMAT_YAML
    )
    storage.write("camera_name", name)
    storage.write("image_width", camera.width)
    storage.write("image_height", camera.height)
    storage.write("camera_matrix", camera.K)
    fisheye = camera.model == "fisheye"
    storage.write("distortion_model", "equidistant" if fisheye else "plumb_bob")
    storage.write("distortion_coefficients", np.array([camera.distortion or [0.0] * (4 if fisheye else 5)]))
    if camera.T_world_cam is not None:
        T = invert(camera.matrix())
        storage.write("R", T[:3, :3])
        storage.write("T", T[:3, 3:])
    return storage.releaseAndGetString()
