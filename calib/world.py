# SPDX-License-Identifier: BSD-3-Clause
"""The world's axes and origin: a sensible default for a waved wand, or surveyed camera positions."""

import csv
from collections.abc import Mapping
from pathlib import Path

import msgspec
import numpy as np
from numpy.typing import ArrayLike, NDArray

from calib.alignment import rigid_motions
from calib.camera import transform
from calib.errors import CalibrationError
from calib.rig import Rig
from camera_node.errors import ConfigError
from camera_node.pose import Pose

Array = NDArray[np.float64]


def upright(cameras: Array, points: Array) -> Array:
    """T_world_any (4, 4): the world that a person would choose for cameras mounted upright.

    z is the direction to which all image rows are nearest to level (the up vector of Brown and Lowe 2007, section 5),
    upwards for most cameras; where all look the same way, the mean of their up axes settles the rest. The origin lies
    under the middle of the points, z = 0 at the lowest of them; x is the first camera's right.

    Args:
        cameras: (C, 4, 4) T_any_cam.
        points: (N, 3) where the wand has been.
    """
    right, up = cameras[:, :3, 0], -cameras[:, :3, 1].mean(axis=0)
    # One part in a thousand for the mean up axis decides what level rows leave open.
    scatter = right.T @ right / len(right) - 0.001 * np.outer(up, up)
    z = np.linalg.eigh(scatter)[1][:, 0]
    z = z if z @ up >= 0 else -z
    x = right[0] - (right[0] @ z) * z
    x /= np.linalg.norm(x)
    T = np.eye(4)
    T[:3, :3] = np.array([x, np.cross(z, x), z])
    turned = points @ T[:3, :3].T
    T[:3, 3] = -np.array([*np.median(turned[:, :2], axis=0), turned[:, 2].min()])
    return T


def move(rig: Rig, T: Array) -> Rig:
    """The rig in another world: T (4, 4) is T_new_old. Covariances stay: they are in the cameras' own frames."""
    cameras = {
        name: camera
        if camera.T_world_cam is None
        else msgspec.structs.replace(camera, T_world_cam=Pose.from_matrix(T @ camera.matrix()))
        for name, camera in rig.cameras.items()
    }
    return msgspec.structs.replace(rig, cameras=cameras)


def align(rig: Rig, positions: Mapping[str, ArrayLike]) -> tuple[Rig, dict[str, float]]:
    """Move the world so that cameras stand where they were surveyed; rigid, the rig keeps its scale.

    Args:
        rig: with three or more placed cameras that `positions` names.
        positions: (3,) metres by camera.

    Returns:
        the moved rig, and each surveyed camera's distance from its surveyed place, metres.

    Raises:
        CalibrationError: fewer than three placed cameras are surveyed, or they stand on a line.
    """
    names = [name for name in rig.placed() if name in positions]
    if len(names) < 3:
        raise CalibrationError(
            f"three or more placed cameras must be surveyed to fix a world, {len(names)} "
            f"{'is' if len(names) == 1 else 'are'} ({', '.join(names) or 'none'}); add their positions"
        )
    here = np.array([rig.cameras[name].matrix()[:3, 3] for name in names])
    there = np.array([positions[name] for name in names], float)
    for points, which in ((there, "surveyed positions"), (here, "cameras")):
        spread = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
        if spread[1] < 0.02 * spread[0] or spread[0] < 1e-6:
            raise CalibrationError(
                f"the {which} of {', '.join(names)} lie on a line: the turn about it stays open; "
                "survey a camera away from that line"
            )
    T = rigid_motions(here, there)
    miss = np.linalg.norm(transform(T, here) - there, axis=1)
    return move(rig, T), dict(zip(names, miss.tolist(), strict=True))


def read_positions(path: Path) -> dict[str, Array]:
    """Read surveyed positions: columns camera, x, y, z, metres.

    Raises:
        ConfigError: the file is missing, lacks a column, names a camera twice or holds no numbers.
    """
    try:
        with path.open(newline="", encoding="utf-8") as file:
            reader = csv.DictReader(file)
            if missing := {"camera", "x", "y", "z"} - set(reader.fieldnames or ()):
                raise ConfigError(
                    f"{path} lacks the column {', '.join(sorted(missing))}; it needs camera,x,y,z"
                )
            positions: dict[str, Array] = {}
            for row in reader:
                positions[_new_name(row["camera"], positions, path)] = _point(row, path, reader.line_num)
    except (OSError, UnicodeDecodeError):
        raise ConfigError(f"{path} can't be read; it needs the columns camera,x,y,z") from None
    return positions


def _new_name(name: str, positions: Mapping[str, Array], path: Path) -> str:
    if name in positions:
        raise ConfigError(f"{path} names camera '{name}' twice; keep one")
    return name


def _point(row: Mapping[str, str], path: Path, line: int) -> Array:
    try:
        point = np.array([float(row[axis]) for axis in "xyz"])
    except (TypeError, ValueError):
        point = np.full(3, np.nan)
    if not np.isfinite(point).all():
        raise ConfigError(f"{path}, line {line}: x, y and z must be numbers, in metres")
    return point
