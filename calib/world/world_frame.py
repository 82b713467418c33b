# SPDX-License-Identifier: BSD-3-Clause
"""The world's axes and origin: a sensible default for a waved wand, surveyed places, or a wand that stands upright."""

import csv
from collections.abc import Mapping
from pathlib import Path

import msgspec
import numpy as np
from numpy.typing import ArrayLike

from calib.errors import CalibrationError
from calib.rig.camera import transform
from calib.rig.rig import Rig
from camera_node.arrays import Array
from camera_node.config import load_yaml
from camera_node.errors import ConfigError
from camera_node.geometry.pose import Pose, rigid_motions

LEVEL = 0.7  # of a plane's normal that is upright: below, roundels hang on a wall
MISFIT = 0.1  # of the survey's extent, that places may miss: beyond, names or units are wrong


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
    T = _level(z, right[0], np.zeros(3))
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


def rescale(rig: Rig, scale: float) -> Rig:
    """The rig with all lengths, and their standard deviations, times `scale`."""
    by = np.array([1.0, 1.0, 1.0, scale, scale, scale])
    cameras = {}
    for name, camera in rig.cameras.items():
        if camera.T_world_cam is not None:
            T = camera.matrix()
            T[:3, 3] *= scale
            camera = msgspec.structs.replace(camera, T_world_cam=Pose.from_matrix(T))
        if camera.covariance is not None:
            cov = np.array(camera.covariance) * np.outer(by, by)
            camera = msgspec.structs.replace(camera, covariance=tuple(map(tuple, cov.tolist())))
        cameras[name] = camera
    return msgspec.structs.replace(rig, cameras=cameras)


def align(rig: Rig, positions: Mapping[str, ArrayLike]) -> tuple[Rig, dict[str, float]]:
    """Move the world so that cameras stand where they were surveyed; rigid, a metric rig keeps its scale.

    Args:
        rig: with three or more placed cameras that `positions` names.
        positions: (3,) metres by camera.

    Returns:
        the moved rig, and each surveyed camera's distance from its surveyed place, metres.

    Raises:
        CalibrationError: fewer than three placed cameras are surveyed, they stand on a line, or nothing fits.
    """
    return align_places(
        rig, {name: camera.matrix()[:3, 3] for name, camera in rig.placed().items()}, positions
    )


def align_places(
    rig: Rig, here: Mapping[str, Array], there: Mapping[str, ArrayLike], what: str = "placed camera"
) -> tuple[Rig, dict[str, float]]:
    """Move the world so that what is `here` (3,) by name, in the rig's world, comes to where it is in `there`.

    Rigid where the rig knows metres; a rig up to scale takes the scale of the places.

    Returns:
        the moved rig, and the distance of each of the places from where it should be, metres.

    Raises:
        CalibrationError: fewer than three places are in both, they lie on a line, or they do not fit each other.
    """
    names = [name for name in there if name in here]
    if len(names) < 3:
        raise CalibrationError(
            f"three or more {what}s must be surveyed to fix a world, {len(names)} "
            f"{'is' if len(names) == 1 else 'are'} ({', '.join(names) or 'none'}); add their positions"
        )
    a, b = (np.array([places[name] for name in names], float) for places in (here, there))
    for points, which in ((b, "surveyed positions"), (a, f"{what}s")):
        _require_plane(points, f"{which} of {', '.join(names)}", what)
    scale = _extent(b) / _extent(a)
    if rig.calibration.get("metric") is False:
        rig, a = rescale(rig, scale), a * scale
        rig = msgspec.structs.replace(rig, calibration={**rig.calibration, "metric": True})
    T = rigid_motions(a, b)
    miss = np.linalg.norm(transform(T, a) - b, axis=1)
    if np.sqrt((miss**2).mean()) > MISFIT * _extent(b):
        raise CalibrationError(
            f"the surveyed positions do not fit: they miss by {np.sqrt((miss**2).mean()):.3f} m (RMS), and the survey "
            f"is {scale:.3f} times as large as the rig; are names, metres and the wand's lengths right?"
        )
    return move(rig, T), dict(zip(names, miss.tolist(), strict=True))


def require_above(rig: Rig, places: Mapping[str, ArrayLike]) -> None:
    """Raise CalibrationError where cameras would see roundels that lie level from below: of three places, a mirrored
    arrangement fits as well, with the world upside down.

    Args:
        rig: with placed cameras, in the world of the places.
        places: (3,) metres by name, of roundels whose printed sides look up.
    """
    points = np.array(list(places.values()), float)
    normal = np.linalg.svd(points - points.mean(axis=0))[2][2]
    heights = np.array([c.matrix()[2, 3] for c in rig.placed().values()]) - points[:, 2].mean()
    if abs(normal[2]) > LEVEL and np.median(heights) < 0:
        raise CalibrationError(
            "the places are mirrored: the cameras would stand below the floor; x, y and z must be right-handed, z up "
            "(x to the east and y to the north, not the other way round)"
        )


def _extent(points: Array) -> float:
    """Root mean square distance from the middle."""
    return float(np.sqrt(((points - points.mean(axis=0)) ** 2).sum(axis=1).mean()))


def _require_plane(points: Array, which: str, what: str) -> None:
    spread = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    if spread[1] < 0.02 * spread[0] or spread[0] < 1e-6:
        raise CalibrationError(
            f"the {which} lie on a line: the turn about it stays open; survey a {what.split()[-1]} away from that line"
        )


def stand(rig: Rig, markers: ArrayLike, foot_m: float = 0.0) -> Rig:
    """The world of a straight wand that stands upright on the floor: z along it, the origin at its foot.

    Upwards is where the cameras' image rows say; x is the first camera's right, made level.

    Args:
        rig: with placed cameras.
        markers: (M, 3) the wand's markers in the rig's world.
        foot_m: from the floor to the centre of the lowest marker.
    """
    markers = np.asarray(markers, float)
    cameras = np.array([camera.matrix() for camera in rig.placed().values()])
    z = np.linalg.svd(markers - markers.mean(axis=0))[2][0]
    z = z if z @ -cameras[:, :3, 1].sum(axis=0) >= 0 else -z
    lowest = markers[(markers @ z).argmin()]
    return move(rig, _level(z, cameras[0, :3, 0], lowest - foot_m * z))


def _level(z: Array, right: Array, origin: Array) -> Array:
    """T_new_old (4, 4) of the world with this unit z (3,), x nearest to `right` (3,), and origin (3,)."""
    x = right - (right @ z) * z
    x /= np.linalg.norm(x)
    T = np.eye(4)
    T[:3, :3] = np.array([x, np.cross(z, x), z])
    T[:3, 3] = -T[:3, :3] @ origin
    return T


def read_positions(path: Path, key: str = "camera") -> dict[str, Array]:
    """Read surveyed positions, metres: a CSV with the columns `key` (or `name`), x, y, z, or a YAML map to [x, y, z].

    Raises:
        ConfigError: the file is missing, lacks a column, has a name twice or holds no numbers.
    """
    if path.suffix.lower() in (".yaml", ".yml"):
        return {
            name: np.array(at) for name, at in load_yaml(path, dict[str, tuple[float, float, float]]).items()
        }
    try:
        with path.open(newline="", encoding="utf-8") as file:
            reader = csv.DictReader(file)
            columns = set(reader.fieldnames or ())
            key = key if key in columns else "name"
            if missing := {key, "x", "y", "z"} - columns:
                raise ConfigError(
                    f"{path} lacks the column {', '.join(sorted(missing))}; it needs {key},x,y,z"
                )
            positions: dict[str, Array] = {}
            for row in reader:
                positions[_new_name(row[key], positions, path)] = _point(row, path, reader.line_num)
    except (OSError, UnicodeDecodeError):
        raise ConfigError(f"{path} can't be read; it needs the columns {key},x,y,z") from None
    return positions


def _new_name(name: str, positions: Mapping[str, Array], path: Path) -> str:
    if name in positions:
        raise ConfigError(f"{path} has '{name}' twice; keep one")
    return name


def _point(row: Mapping[str, str], path: Path, line: int) -> Array:
    try:
        point = np.array([float(row[axis]) for axis in "xyz"])
    except (TypeError, ValueError):
        point = np.full(3, np.nan)
    if not np.isfinite(point).all():
        raise ConfigError(f"{path}, line {line}: x, y and z must be numbers, in metres")
    return point
