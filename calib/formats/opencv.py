# SPDX-License-Identifier: BSD-3-Clause
"""OpenCV's camera files (YAML of `cv::FileStorage`) and ROS's `camera_info`, one file a camera.

Matrices are mappings with rows, cols and data, with or without the tag `!!opencv-matrix`. Names: camera_matrix (also
cameraMatrix, K, M1), distortion_coefficients (also distCoeffs, D), image_width and image_height (also image_size), and
in ROS camera_name and distortion_model (samples/cpp/calibration.cpp of OpenCV; camera_calibration_parsers of ROS).
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from calib.errors import CalibrationError
from calib.formats.data import ForeignData, PixelOrigin, make_camera
from calib.rig.camera import Camera
from calib.rig.rig import Rig
from camera_node.foundation.config import is_name, read_yaml, write_atomically
from camera_node.foundation.errors import ConfigError
from camera_node.geometry.pose import invert

FROM_ZERO = PixelOrigin(0)
MATRIX = ("camera_matrix", "cameraMatrix", "Camera_Matrix", "K", "M", "M1", "intrinsic_matrix")
DISTORTION = ("distortion_coefficients", "distCoeffs", "dist_coeffs", "Distortion_Coefficients", "D", "D1")
FISHEYE = ("fisheye", "equidistant")
PINHOLE = ("", "plumb_bob", "rational_polynomial", "pinhole")


def read(paths: Sequence[Path], origin: PixelOrigin) -> ForeignData:
    """Read one camera from each file; it has the name that the file states, else that of the file.

    Raises:
        ConfigError, CalibrationError: a file is not such a file, or has impossible values.
    """
    cameras = {}
    for path in paths:
        data = read_yaml(path, foreign=True)
        if not isinstance(data, Mapping):
            raise ConfigError(f"{path} is not a camera file of OpenCV or ROS")
        stated = str(data.get("camera_name", ""))
        name = stated if is_name(stated) else path.stem
        if name in cameras:
            raise ConfigError(f"{path}: camera '{name}' was already in another file; rename one")
        cameras[name] = _build(path, data, origin)
    return ForeignData(cameras)


def _build(path: Path, data: Mapping[str, Any], origin: PixelOrigin) -> Camera:
    K, distortion = _matrix(path, data, MATRIX), _matrix(path, data, DISTORTION)
    model = str(data.get("distortion_model") or data.get("model") or "")
    if model not in FISHEYE + PINHOLE:
        raise ConfigError(
            f"{path}: can't import the distortion model '{model[:40]}', but plumb_bob and equidistant"
        )
    fisheye = model in FISHEYE or bool(data.get("fisheye_model", 0))
    width, height = _size(path, data)
    centre = origin.read(K.reshape(3, 3)[None, :2, 2])[0]
    return make_camera(
        width=width,
        height=height,
        fx=float(K.reshape(3, 3)[0, 0]),
        fy=float(K.reshape(3, 3)[1, 1]),
        cx=float(centre[0]),
        cy=float(centre[1]),
        distortion=tuple(distortion.tolist()),
        model="fisheye" if fisheye else "pinhole",
    )


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
        values = pair.get("data") if isinstance(pair, Mapping) else pair
        if (
            isinstance(values, list | tuple)
            and len(values) == 2
            and all(isinstance(x, int | float) for x in values)
        ):
            return values[0], values[1]
    raise ConfigError(f"{path} has no image size; add the lines image_width and image_height")


def write(rig: Rig, folder: Path, origin: PixelOrigin) -> list[str]:
    """Write `<camera>.yaml` for each camera, with R and T from the world to the camera where it has a pose.

    Raises:
        CalibrationError: the pixel origin is another than OpenCV's.
    """
    if origin != FROM_ZERO:
        raise CalibrationError(
            "OpenCV counts pixels from 0 at the top left; leave out --first-pixel and --y-up"
        )
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
