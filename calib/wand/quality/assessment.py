# SPDX-License-Identifier: BSD-3-Clause
"""Assesses a wand calibration: the figures of each camera by which it is graded, and the expected errors of points."""

import numpy as np

from calib.rig.camera import LENS, Camera, transform
from calib.rig.coverage import Coverage, cell_centres
from calib.rig.precision_map import SIGMA_PX, FloorGrid, PrecisionMap, map_precision
from calib.rig.triangulation import JointCovariance, camera_jacobians
from calib.wand.bundle_adjustment.covariance import CameraCovariance, camera_covariance
from calib.wand.quality.grade import CameraQuality, RigQuality
from calib.wand.report import NOT_RECORDED
from calib.wand.result import WandCalibration
from camera_node.foundation.arrays import Array, Mask
from camera_node.geometry.body import Body
from camera_node.geometry.pose import invert

CELLS = (4, 6)  # rows and columns of the grid for the coverage of an image
DEPTHS = (0.1, 0.5, 0.9)  # quantiles of the wand's distance, at which the shared image area is computed


def assess(result: WandCalibration, wand: Body, height_m: float = 0.1) -> RigQuality:
    """Grade a calibration.

    Args:
        result: of `calib.wand.calibrate.calibrate`.
        wand: that of the recording.
        height_m: height of the robots' roundels.
    """
    positions = wand_positions(result)
    covariance = camera_covariance(result.adjusted)
    cameras = [_assess_camera(result, k, positions, covariance) for k in range(len(result.names))]
    length_mm, extent = result.report.length_mean_mm, np.linalg.norm(np.ptp(wand.points, axis=0))
    error = None if length_mm is None or extent == 0 else abs(length_mm) / 1e3 / float(extent)
    unplaced = {name: why for name, why in sorted(result.report.unplaced.items()) if why != NOT_RECORDED}
    expected = _predict(result, positions, covariance, height_m) if result.report.metric else None
    return RigQuality(cameras, unplaced, error, expected, result.report.held_out)


def wand_positions(result: WandCalibration) -> Array:
    """Return (N, 3) positions of the wand's basis markers, in the rig's world."""
    T_world_adjusted = result.rig.cameras[result.names[0]].matrix() @ invert(result.adjusted.state.cameras[0])
    return transform(T_world_adjusted, result.adjusted.state.motion[:, 0].reshape(-1, 3))


def _predict(
    result: WandCalibration, positions: Array, covariance: CameraCovariance, height_m: float
) -> PrecisionMap:
    """Predict the errors of points across the area where the wand was."""
    size = len(covariance.joint) * len(covariance.free)
    low, high = np.quantile(positions[:, :2], [0.02, 0.98], axis=0)
    cameras = [result.rig.cameras[name] for name in result.names]
    joint = JointCovariance(covariance.free, covariance.joint.reshape(size, size))
    return map_precision(cameras, FloorGrid.covering(low, high, height_m), SIGMA_PX, joint)


def _assess_camera(
    result: WandCalibration, k: int, positions: Array, covariance: CameraCovariance
) -> CameraQuality:
    row, joint, free = result.report.cameras[k], covariance.joint, covariance.free
    camera = result.rig.cameras[row.name]
    uv = result.observations.uv[(result.observations.camera == k) & result.adjusted.used]
    coverage = Coverage.of(uv, camera.width, camera.height, CELLS)
    distances = np.linalg.norm(positions - camera.matrix()[:3, 3], axis=1)
    others = [result.rig.cameras[name] for name in result.names if name != row.name]
    shared = shared_cells(camera, others, np.quantile(distances, DEPTHS))
    rays = camera.rays(uv)
    points = rays[np.isfinite(rays).all(axis=1)] * float(np.median(distances))
    J = camera_jacobians(camera, points, free)
    figures = {
        "residual_px": row.residual_px,
        "rejected": row.outliers / max(row.outliers + row.observations, 1),
        "pose_px": _rms_px(J, joint[k, :, k]),
        "unused": 1 - coverage.share(shared),
    }
    lens = find_limiting_lens(J, joint, k, [free.index(p) for p in LENS])
    name = "" if lens is None else result.names[lens]
    return CameraQuality(row.name, coverage, shared, figures, name, _rms_px(J, covariance.noise[k, :, k]))


def _rms_px(J: Array, covariance: Array) -> float:
    """Return the RMS image error per coordinate of points with Jacobians (n, 2, d), for a covariance (d, d)."""
    if not len(J):
        return float("nan")
    return float(np.sqrt(np.einsum("nii->n", J @ covariance @ np.swapaxes(J, 1, 2)).mean() / 2))


def find_limiting_lens(J: Array, joint: Array, k: int, lens: list[int]) -> int | None:
    """Return the camera whose lens, if known, would reduce the image errors of camera k most.

    Args:
        J: (n, 2, d) Jacobians of points in the image of camera k.
        joint: (C, d, C, d) covariance of all cameras.
        lens: columns of the lens parameters.

    Returns:
        its index; None if all lenses together would not halve the variance.
    """
    cov_lenses = joint[:, lens][:, :, :, lens]
    cross = np.einsum("nip,pcl->nicl", J, joint[k][:, :, lens])
    single = [_explained(cross[:, :, c], cov_lenses[c, :, c]) for c in range(len(cov_lenses))]
    size = len(lens) * len(single)
    together = _explained(cross.reshape(*J.shape[:2], -1), cov_lenses.reshape(size, size))
    total = float(np.einsum("nip,pq,niq->", J, joint[k, :, k], J))
    return int(np.argmax(single)) if together > total / 2 else None


def _explained(cross: Array, covariance: Array) -> float:
    """Return the variance, summed over pixels, that knowing parameters would remove, from their covariance (l, l) and
    the covariances `cross` (n, 2, l) of the pixels with them."""
    unit = np.sqrt(np.diag(covariance))
    scaled = cross / unit
    return float(np.einsum("nip,pq,niq->", scaled, np.linalg.inv(covariance / np.outer(unit, unit)), scaled))


def shared_cells(camera: Camera, others: list[Camera], distances: Array) -> Mask:
    """Return (rows, columns) the image cells whose points at one of the distances another camera sees too."""
    rays = camera.rays(cell_centres(camera.width, camera.height, CELLS))
    shared = np.zeros(len(rays), bool)
    for distance in distances:
        points = transform(camera.matrix(), rays * distance)
        for other in others:
            shared |= other.sees(other.project_world(points))
    return shared.reshape(CELLS)
