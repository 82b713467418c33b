# SPDX-License-Identifier: BSD-3-Clause
"""COLMAP's text format (https://colmap.github.io/format.html): `cameras.txt`, `images.txt` and an empty `points3D.txt`.

Quaternion and translation take the world into the camera. The centre of the top-left pixel is (0.5, 0.5).
"""

from pathlib import Path

from calib.errors import CalibrationError
from calib.formats.data import PixelOrigin
from calib.rig.camera import Camera
from calib.rig.rig import Rig
from camera_node.foundation.config import write_atomically
from camera_node.geometry.pose import invert, wxyz_from_rotation

FROM_ZERO = PixelOrigin(0)
HALF_PX = 0.5
SHORT, FULL = 4, 8  # distortion coefficients of OPENCV and of FULL_OPENCV


def write(rig: Rig, folder: Path, origin: PixelOrigin) -> list[str]:
    """Write the model; images are named `<camera>.png`. Returns the names of the files.

    Raises:
        CalibrationError: a lens has more coefficients than COLMAP's models, or the pixel origin is not OpenCV's.
    """
    if origin != FROM_ZERO:
        raise CalibrationError("COLMAP has its own pixel origin; leave out --first-pixel and --y-up")
    cameras, images = [], []
    for number, (name, camera) in enumerate(rig.cameras.items(), 1):
        model, distortion = _model(name, camera)
        parameters = [camera.fx, camera.fy, camera.cx + HALF_PX, camera.cy + HALF_PX, *distortion]
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
