# SPDX-License-Identifier: BSD-3-Clause
"""Kalibr's `camchain.yaml` (https://github.com/ethz-asl/kalibr/wiki/yaml-formats), and TagSLAM's `cameras.yaml`.

cam0, cam1, ...: camera_model pinhole with intrinsics fu, fv, pu, pv; distortion_model radtan (OpenCV's k1, k2, p1, p2),
plumb_bob (the same with k3; TagSLAM and ROS), equidistant (OpenCV's fisheye) or none; resolution; T_cn_cnm1, which
takes points from the camera before into this one; timeshift_cam_imu in seconds: t_imu = t_cam + shift. The first
camera is the world.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from calib.formats.data import ForeignData, PixelOrigin, make_camera, with_coefficients
from calib.rig.camera import Camera
from calib.rig.rig import Rig
from camera_node.foundation.arrays import Array
from camera_node.foundation.config import read_yaml, write_atomically
from camera_node.foundation.errors import ConfigError
from camera_node.geometry.pose import invert

MODELS = ("radtan", "plumb_bob", "equidistant", "none")
COEFFICIENTS = 4
ROTATION_TOLERANCE = 1e-3  # of R^T R from I


def read(paths: Sequence[Path], origin: PixelOrigin) -> ForeignData:
    """Read one camchain; without transforms its cameras have no poses.

    A camera has the name of its topic's first part, such as left of /left/image_raw, if these differ; else cam0, ...

    Raises:
        ConfigError, CalibrationError: the file is not a camchain of pinhole cameras.
    """
    if len(paths) != 1:
        raise ConfigError("give one camchain.yaml")
    data = read_yaml(paths[0])
    entries = (
        [data[f"cam{k}"] for k in range(len(data)) if f"cam{k}" in data] if isinstance(data, Mapping) else []
    )
    if not entries or not all(isinstance(entry, Mapping) for entry in entries):
        raise ConfigError(f"{paths[0]} has no cameras cam0, cam1, ...; is it a camchain of Kalibr?")
    T, first_shift, cameras, chained = np.eye(4), None, {}, len(entries) > 1 and "T_cn_cnm1" in entries[1]
    for k, entry in enumerate(entries):
        where = f"{paths[0]}: cam{k}"
        if k and "T_cn_cnm1" in entry:
            T = _motion(where, entry["T_cn_cnm1"]) @ T
        chained &= k == 0 or "T_cn_cnm1" in entry
        shift = _number(where, entry.get("timeshift_cam_imu", 0.0))
        first_shift = shift if first_shift is None else first_shift
        cameras[f"cam{k}"] = _build(where, entry, origin, T if chained else None, 1e3 * (shift - first_shift))
    return ForeignData(_rename(cameras, entries))


def _number(where: str, value: Any) -> float:
    if not isinstance(value, int | float):
        raise ConfigError(f"{where}: timeshift_cam_imu is not a number")
    return float(value)


def _motion(where: str, rows: Any) -> Array:
    try:
        T = np.asarray(rows, float).reshape(4, 4)
    except (TypeError, ValueError):
        raise ConfigError(f"{where}: T_cn_cnm1 is not a matrix of 4 x 4 numbers") from None
    if not np.abs(T[:3, :3].T @ T[:3, :3] - np.eye(3)).max() < ROTATION_TOLERANCE:
        raise ConfigError(f"{where}: T_cn_cnm1 has no rotation")
    return T


def _build(
    where: str, entry: Mapping[str, Any], origin: PixelOrigin, T: Array | None, offset_ms: float
) -> Camera:
    distortion_model = str(entry.get("distortion_model", "none"))
    if entry.get("camera_model") != "pinhole" or distortion_model not in MODELS:
        raise ConfigError(
            f"{where}: camera_model '{entry.get('camera_model')}' with distortion_model '{distortion_model}' can't be "
            "imported; pinhole with radtan, plumb_bob, equidistant or none can"
        )
    try:
        fx, fy, *centre = (float(x) for x in entry["intrinsics"])
        size = [float(x) for x in entry["resolution"]]
        distortion = [float(x) for x in entry.get("distortion_coeffs") or ()]
    except (KeyError, TypeError, ValueError):
        raise ConfigError(f"{where}: its numbers can't be read; distortion_coeffs needs 4 or 5") from None
    if len(size) != 2 or len(centre) != 2:
        raise ConfigError(f"{where}: intrinsics needs 4 numbers, and resolution 2")
    shape = distortion if distortion_model != "none" else ()
    centre, fisheye = origin.read(np.array([centre]))[0], distortion_model == "equidistant"
    return make_camera(size, (fx, fy), centre, shape, fisheye, T, offset_ms)


def _rename(cameras: Mapping[str, Camera], entries: Sequence[Mapping[str, Any]]) -> dict[str, Camera]:
    topics = [str(entry.get("rostopic", "")).strip("/").split("/")[0] for entry in entries]
    usable = len(set(topics)) == len(topics) and all(topic.isidentifier() for topic in topics)
    return dict(zip(topics if usable else cameras, cameras.values(), strict=True))


def write(rig: Rig, folder: Path, origin: PixelOrigin) -> list[str]:
    """Write `camchain.yaml`; return its name.

    Raises:
        CalibrationError: a lens can't be expressed with k1, k2, p1, p2, or the pixel origin is not OpenCV's.
    """
    origin.require_opencv("Kalibr")
    chain, before = {}, None
    placed = len(rig.placed()) == len(rig.cameras)
    for k, (name, camera) in enumerate(rig.cameras.items()):
        lens = with_coefficients(name, camera, COEFFICIENTS)[0]
        entry: dict[str, Any] = {"camera_model": "pinhole", "intrinsics": lens.parameters[:4].tolist()}
        entry["distortion_model"] = "equidistant" if camera.model == "fisheye" else "radtan"
        entry |= {"distortion_coeffs": list(lens.distortion), "resolution": [camera.width, camera.height]}
        entry |= {"rostopic": f"/{name}/image_raw", "timeshift_cam_imu": 1e-3 * camera.time_offset_ms}
        if placed and before is not None:
            entry["T_cn_cnm1"] = (invert(camera.matrix()) @ before.matrix()).tolist()
        chain[f"cam{k}"], before = entry, camera
    write_atomically(
        folder / "camchain.yaml", yaml.safe_dump(chain, sort_keys=False, default_flow_style=None)
    )
    return ["camchain.yaml"]
