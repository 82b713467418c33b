# SPDX-License-Identifier: BSD-3-Clause
"""By how much what is unknown of cameras moves what they see, and whose lens is to blame for it."""

import numpy as np

from calib.rig.camera import LENS
from calib.rig.triangulation import camera_jacobians
from calib.wand.outcome import WandCalibration
from camera_node.arrays import Array


def pose_px(result: WandCalibration, k: int, uv: Array, distance: float, covariance: Array) -> float:
    """RMS, per coordinate, by which a `covariance` (C, d, C, d) of camera k moves points at a distance in its image;
    pixels."""
    if not len(uv):
        return float("nan")
    J = _image_jacobians(result, k, uv, distance)
    moved = J @ covariance[k, :, k] @ np.swapaxes(J, 1, 2)
    return float(np.sqrt(np.einsum("nii->n", moved).mean() / 2))


def lens_to_blame(result: WandCalibration, k: int, uv: Array, distance: float, covariance: Array) -> str:
    """The camera by whose lens, were it known, these points would be known best; empty where all lenses together would
    not halve the variance. `covariance` (C, d, C, d) is that of all cameras' parameters."""
    J = _image_jacobians(result, k, uv, distance)
    lens = [result.adjusted.problem.free.index(p) for p in LENS]
    of_lenses = covariance[:, lens][:, :, :, lens]
    moved = np.einsum("nip,pcl->nicl", J, covariance[k][:, :, lens])
    told = [_explained(moved[:, :, c], of_lenses[c, :, c]) for c in range(len(of_lenses))]
    together = _explained(moved.reshape(*J.shape[:2], -1), of_lenses.reshape(4 * len(told), -1))
    whole = float(np.einsum("nip,pq,niq->", J, covariance[k, :, k], J))
    return result.names[int(np.argmax(told))] if together > whole / 2 else ""


def _explained(moved: Array, covariance: Array) -> float:
    """The variance, summed over pixels, that is gone once parameters are known with which it has covariances."""
    unit = np.sqrt(np.diag(covariance))
    scaled = moved / unit
    return float(np.einsum("nip,pq,niq->", scaled, np.linalg.inv(covariance / np.outer(unit, unit)), scaled))


def _image_jacobians(result: WandCalibration, k: int, uv: Array, distance: float) -> Array:
    """(n, 2, d) how points at a distance, where camera k saw `uv`, move in its image with its parameters."""
    camera = result.rig.cameras[result.names[k]]
    rays = camera.rays(uv)
    return camera_jacobians(
        camera, rays[np.isfinite(rays).all(axis=1)] * distance, result.adjusted.problem.free
    )
