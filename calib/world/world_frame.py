# SPDX-License-Identifier: BSD-3-Clause
"""Chooses the world frame: upright by default, by surveyed positions, or by a wand that stands upright."""

from collections.abc import Mapping

import msgspec
import numpy as np
from numpy.typing import ArrayLike

from calib.errors import CalibrationError
from calib.rig.camera import span_dimension, transform
from calib.rig.estimation import rms
from calib.rig.rig import Rig
from camera_node.foundation.arrays import Array
from camera_node.geometry.pose import Pose, rigid_motions

MIN_LEVEL = 0.7  # upward component of a plane's normal: below, the plane is a wall
MAX_MISFIT = 0.1  # RMS distance over the survey's extent: beyond, names or units are wrong


def upright_frame(cameras: Array, points: Array) -> Array:
    """The default world for cameras that are mounted upright.

    z is the direction to which all image rows are most nearly perpendicular (the up vector of Brown and Lowe 2007,
    section 5), upwards for most cameras. If all cameras look in the same direction, the mean of their up axes resolves
    the rest. The origin is below the median of the points, with z = 0 at the lowest point. x is the first camera's
    right.

    Args:
        cameras: (C, 4, 4) T_any_cam.
        points: (N, 3) positions of the wand, in the same frame.

    Returns:
        T_world_any (4, 4).
    """
    right, up = cameras[:, :3, 0], -cameras[:, :3, 1].mean(axis=0)
    # A small weight on the mean up axis resolves the directions that image rows leave open.
    scatter = right.T @ right / len(right) - 0.001 * np.outer(up, up)
    z = np.linalg.eigh(scatter)[1][:, 0]
    z = z if z @ up >= 0 else -z
    T = _level_frame(z, right[0], np.zeros(3))
    rotated = points @ T[:3, :3].T
    T[:3, 3] = -np.array([*np.median(rotated[:, :2], axis=0), rotated[:, 2].min()])
    return T


def move_rig(rig: Rig, T_new_old: Array) -> Rig:
    """Express a rig in another world frame. Covariances stay the same: they are in the cameras' own frames."""
    cameras = {
        name: camera
        if camera.T_world_cam is None
        else msgspec.structs.replace(camera, T_world_cam=Pose.from_matrix(T_new_old @ camera.matrix()))
        for name, camera in rig.cameras.items()
    }
    return msgspec.structs.replace(rig, cameras=cameras)


def scale_rig(rig: Rig, scale: float) -> Rig:
    """Multiply all lengths of a rig, and their standard deviations, by `scale`."""
    factors = np.array([1.0, 1.0, 1.0, scale, scale, scale])
    cameras = {}
    for name, camera in rig.cameras.items():
        if camera.T_world_cam is not None:
            T = camera.matrix()
            T[:3, 3] *= scale
            camera = msgspec.structs.replace(camera, T_world_cam=Pose.from_matrix(T))
        if camera.covariance is not None:
            cov = np.array(camera.covariance) * np.outer(factors, factors)
            camera = msgspec.structs.replace(camera, covariance=tuple(map(tuple, cov.tolist())))
        if camera.errors is not None:
            rows = [[(scale if 3 <= k < 6 else 1.0) * x for x in row] for k, row in enumerate(camera.errors)]
            camera = msgspec.structs.replace(camera, errors=tuple(map(tuple, rows)))
        cameras[name] = camera
    return msgspec.structs.replace(rig, cameras=cameras)


def align_cameras(rig: Rig, surveyed: Mapping[str, ArrayLike]) -> tuple[Rig, dict[str, float]]:
    """Move the world so that the cameras are at their surveyed positions.

    Args:
        rig: with three or more placed cameras that `surveyed` names.
        surveyed: positions (3,) by camera, metres.

    Returns:
        the moved rig, and the distance of each surveyed camera from its surveyed position, metres.

    Raises:
        CalibrationError: see `align_positions`.
    """
    positions = {name: camera.matrix()[:3, 3] for name, camera in rig.placed().items()}
    return align_positions(rig, positions, surveyed)


def align_positions(
    rig: Rig, measured: Mapping[str, Array], surveyed: Mapping[str, ArrayLike], kind: str = "placed camera"
) -> tuple[Rig, dict[str, float]]:
    """Move the world so that measured positions match surveyed ones.

    The motion is rigid. A rig without metric scale also takes the scale of the survey.

    Args:
        rig: with placed cameras.
        measured: positions (3,) by name, in the rig's world.
        surveyed: the same positions in the new world, metres.
        kind: what the names stand for, in errors.

    Returns:
        the moved rig, and the distance of each position from its surveyed one, metres.

    Raises:
        CalibrationError: fewer than three names occur in both, the positions lie on a line, or they do not match.
    """
    names = [name for name in surveyed if name in measured]
    if len(names) < 3:
        raise CalibrationError(
            f"three or more {kind}s with surveyed positions fix a world; there are {len(names)} "
            f"({', '.join(names) or 'none'}); survey more"
        )
    a, b = (np.array([positions[name] for name in names], float) for positions in (measured, surveyed))
    for points, which in ((b, "surveyed positions"), (a, f"{kind}s")):
        _check_not_collinear(points, f"{which} of {', '.join(names)}", kind)
    scale = _extent(b) / _extent(a)
    if rig.calibration.get("metric") is False:
        rig, a = scale_rig(rig, scale), a * scale
        rig = msgspec.structs.replace(rig, calibration={**rig.calibration, "metric": True})
    T = rigid_motions(a, b)
    distances = np.linalg.norm(transform(T, a) - b, axis=1)
    if (misfit := rms(distances)) > MAX_MISFIT * _extent(b):
        raise CalibrationError(
            f"the surveyed positions do not match: the RMS distance is {misfit:.3f} m, and the survey is {scale:.3f} "
            "times as large as the rig; check names, units (metres) and the wand's lengths"
        )
    return move_rig(rig, T), dict(zip(names, distances.tolist(), strict=True))


def check_above(rig: Rig, roundels: Mapping[str, ArrayLike]) -> None:
    """Check that cameras see level roundels from above.

    Three positions match their mirror image as well, with the world upside down.

    Args:
        rig: with placed cameras, in the world of the roundels.
        roundels: positions (3,) by name, metres; the printed sides face up.

    Raises:
        CalibrationError: most cameras would be below the roundels.
    """
    points = np.array(list(roundels.values()), float)
    normal = np.linalg.svd(points - points.mean(axis=0))[2][2]
    heights = np.array([c.matrix()[2, 3] for c in rig.placed().values()]) - points[:, 2].mean()
    if abs(normal[2]) > MIN_LEVEL and np.median(heights) < 0:
        raise CalibrationError(
            "the surveyed positions are mirrored: the cameras would be below the floor; x, y and z must be "
            "right-handed with z up (x to the east and y to the north, not the other way round)"
        )


def align_standing_wand(rig: Rig, markers: ArrayLike, foot_m: float = 0.0) -> Rig:
    """Move the world to a straight wand that stands upright on the floor: z along it, the origin at its foot.

    Upwards is upwards in most images. x is the first camera's right, made level.

    Args:
        rig: with placed cameras.
        markers: (M, 3) positions of the wand's markers in the rig's world.
        foot_m: height of the centre of the lowest marker above the floor.
    """
    markers = np.asarray(markers, float)
    cameras = np.array([camera.matrix() for camera in rig.placed().values()])
    z = np.linalg.svd(markers - markers.mean(axis=0))[2][0]
    z = z if z @ -cameras[:, :3, 1].sum(axis=0) >= 0 else -z
    lowest = markers[(markers @ z).argmin()]
    return move_rig(rig, _level_frame(z, cameras[0, :3, 0], lowest - foot_m * z))


def _extent(points: Array) -> float:
    """Root mean square distance from the centroid."""
    return float(np.sqrt(((points - points.mean(axis=0)) ** 2).sum(axis=1).mean()))


def _check_not_collinear(points: Array, which: str, kind: str) -> None:
    if span_dimension(points) < 2:
        raise CalibrationError(
            f"the {which} lie on a line, which leaves the rotation about it open; survey a {kind.split()[-1]} away "
            "from that line"
        )


def _level_frame(z: Array, right: Array, origin: Array) -> Array:
    """T_new_old (4, 4) of the frame with this unit z (3,), x nearest to `right` (3,), and origin (3,)."""
    x = right - (right @ z) * z
    x /= np.linalg.norm(x)
    T = np.eye(4)
    T[:3, :3] = np.array([x, np.cross(z, x), z])
    T[:3, 3] = -T[:3, :3] @ origin
    return T
