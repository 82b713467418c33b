# SPDX-License-Identifier: BSD-3-Clause
"""The errors of calibrated cameras, as users of a rig count them: covariances of all cameras together, and their size
in the image."""

from collections.abc import Mapping, Sequence
from itertools import permutations

import msgspec
import numpy as np

from calib.rig.camera import LENS, OFFSET, PER_CAMERA, POSE, Camera, pixel_jacobians
from camera_node.foundation.arrays import Array
from camera_node.geometry.lens import Lens

# The errors of a camera, by their columns: rotation and translation in its own frame (rad, m), clock offset (s), and
# logarithm of the focal length.
ERRORS = 8
PARAMETERS = (*POSE, *OFFSET, LENS[0])  # the same, as `calib.rig.camera` numbers them
POSITION = slice(3, 6)  # of its errors
OF_IMAGE = np.arange(ERRORS) != 6  # all but the clock's displace the image of a point at rest
MAX_JOINT = 16  # cameras whose covariances between each other fit into a rig's message: 16,384 numbers
DIGITS = 6  # of a number in the file
# Error in the image of a rig that states no covariance: 0.01 to 0.06 px after a wand calibration with carefully
# calibrated lenses (`python -m tests.benchmarks.calibration`).
USUAL_PX = 0.05
GRID = np.linspace(0.1, 0.9, 5)  # of the image, where its error is computed


def error_covariance(cameras: Sequence[Camera], unstated_px: float = USUAL_PX) -> Array:
    """(8 C, 8 C) covariance of the errors of C placed cameras; `unstated_px` in the image for those that state none.

    Rows of `Camera.errors` are of one factor where they are equally long. Other cameras are independent.
    """
    n, d = len(cameras), ERRORS * len(cameras)
    joint = np.zeros((n, ERRORS, n, ERRORS))
    rows = {k: np.array(camera.errors) for k, camera in enumerate(cameras) if camera.errors is not None}
    width = max((row.shape[1] for row in rows.values()), default=0)
    for k, (camera, range_m) in enumerate(zip(cameras, working_ranges(cameras).tolist(), strict=True)):
        if k in rows:
            joint[k, :, k] = rows[k] @ rows[k].T
        elif camera.covariance is not None:
            joint[k, :6, k, :6] = np.array(camera.covariance)
        else:
            joint[k, :6, k, :6] = usual_covariance(camera, range_m, unstated_px)
    together = [k for k, row in rows.items() if row.shape[1] == width > ERRORS]
    for k, m in permutations(together, 2):
        joint[k, :, m] = rows[k] @ rows[m].T
    return joint.reshape(d, d)


def with_errors(cameras: Mapping[str, Camera], covariance: Array) -> dict[str, Camera]:
    """The cameras with their part of a joint covariance (8 C, 8 C), in their order; without the covariances between
    them beyond `MAX_JOINT` cameras."""
    n = len(cameras)
    if n > MAX_JOINT:
        full = np.array([covariance_factor(block) for block in own_blocks(covariance)]).reshape(
            n * ERRORS, ERRORS
        )
    else:
        full = covariance_factor(covariance)
    stated = {}
    for k, (name, camera) in enumerate(cameras.items()):
        rows = full[ERRORS * k : ERRORS * (k + 1)]
        errors = tuple(tuple(float(f"{x:.{DIGITS}g}") for x in row) for row in rows.tolist())
        stated[name] = msgspec.structs.replace(camera, errors=errors)
    return stated


def as_pose_errors(lens: Lens, points: Array, parameters: tuple[int, ...]) -> Array:
    """(8, d) the errors that displace the images of points (N, 3), camera frame, most as errors of d `parameters`
    (`calib.rig.camera`) do: least squares.

    A principal point that is off looks like a turn, and what a wand does not tell apart does not matter where it was
    waved. Poses and lenses apart would claim both.
    """
    found = np.zeros((ERRORS, len(parameters)))
    _, _, J_pose, J_lens = pixel_jacobians(lens, points)
    by_error = np.concatenate([J_pose, J_lens[:, :, :1]], axis=2)
    by_parameter = np.zeros((len(points), 2, PER_CAMERA))
    by_parameter[:, :, POSE], by_parameter[:, :, LENS] = J_pose, J_lens
    known = np.isfinite(by_error).all(axis=(1, 2))
    B, A = by_error[known].reshape(-1, 7), by_parameter[known][:, :, parameters].reshape(-1, len(parameters))
    found[OF_IMAGE] = np.linalg.lstsq(B, A, rcond=None)[0]
    for k, parameter in enumerate(parameters):
        found[6, k] = float(parameter == OFFSET[0])
    return found


def covariance_factor(covariance: Array) -> Array:
    """(n, n) lower triangular L with L L^T the covariance (n, n), which may be singular: what rounding makes negative
    counts as zero."""
    scale = np.sqrt(np.maximum(np.diag(covariance), np.finfo(float).tiny ** 0.5))
    variances, directions = np.linalg.eigh(covariance / np.outer(scale, scale))
    root = directions * np.sqrt(np.maximum(variances, 0.0))
    return scale[:, None] * np.asarray(np.linalg.qr(root.T, mode="r"), float).T


def own_blocks(covariance: Array) -> Array:
    """(C, 8, 8) covariances of single cameras, of a joint one (8 C, 8 C)."""
    n = len(covariance) // ERRORS
    return np.einsum("kikj->kij", covariance.reshape(n, ERRORS, n, ERRORS))


def usual_covariance(camera: Camera, range_m: float, error_px: float = USUAL_PX) -> Array:
    """(6, 6) of a pose whose rotation and position displace the image by `error_px` together, half the square each."""
    pixel = error_px / np.sqrt(2 * camera.fx * camera.fy)
    return np.diag(np.repeat([pixel, pixel * range_m], 3) ** 2)


def image_errors(cameras: Sequence[Camera], covariance: Array) -> Array:
    """(C,) RMS errors of the images by the errors of their cameras (8 C, 8 C), pixels, for each coordinate."""
    return np.sqrt(np.einsum("kij,kij->k", image_metrics(cameras), own_blocks(covariance)))


def image_metrics(cameras: Sequence[Camera]) -> Array:
    """(C, 8, 8) M with e^T M e the mean square, px^2, of what errors e (8,) of a camera displace a coordinate of the
    image of a point at rest."""
    found = np.zeros((len(cameras), ERRORS, ERRORS))
    own = np.flatnonzero(OF_IMAGE)
    for k, (camera, range_m) in enumerate(zip(cameras, working_ranges(cameras).tolist(), strict=True)):
        v, u = np.meshgrid(GRID * camera.height, GRID * camera.width, indexing="ij")
        rays = camera.rays(np.column_stack([u.ravel(), v.ravel()]))
        rays = rays[np.isfinite(rays).all(axis=1)]
        _, _, J_pose, J_lens = pixel_jacobians(camera, range_m * rays)
        J = np.concatenate([J_pose, J_lens[:, :, :1]], axis=2)
        if len(J):
            found[k][np.ix_(own, own)] = np.einsum("nai,naj->ij", J, J) / (2 * len(J))
    return found


def errors_of_size(T: Array) -> Array:
    """(8 C,) the errors of cameras at poses T_world_cam (C, 4, 4), by the logarithm of the size of their arena."""
    grown = np.zeros((len(T), ERRORS))
    grown[:, POSITION] = np.einsum("kji,kj->ki", T[:, :3, :3], T[:, :3, 3])
    return grown.ravel()


def errors_of_motion(T: Array) -> Array:
    """(8 C, 6) the errors of cameras at poses T_world_cam (C, 4, 4), by a rotation about the origin and a translation
    that all have in common, world frame."""
    moved, into = np.zeros((len(T), ERRORS, 6)), T[:, :3, :3].transpose(0, 2, 1)
    moved[:, :3, :3] = moved[:, POSITION, 3:] = into
    moved[:, POSITION, :3] = np.cross(into, into @ T[:, :3, 3:], axis=1)
    return moved.reshape(-1, 6)


def working_ranges(cameras: Sequence[Camera]) -> Array:
    """(C,) distances of placed cameras from the point nearest to all optical axes, metres; from the other cameras where
    these are parallel, and 1 for a single camera."""
    T = np.array([camera.matrix() for camera in cameras]).reshape(-1, 4, 4)
    centres, axes = T[:, :3, 3], T[:, :3, 2]
    across = np.eye(3) - axes[:, :, None] * axes[:, None]
    A, b = across.sum(axis=0), np.einsum("nij,nj->i", across, centres)
    point = np.linalg.lstsq(A + 1e-3 * np.eye(3) * len(T), b + 1e-3 * centres.sum(axis=0), rcond=None)[0]
    ranges = np.linalg.norm(centres - point, axis=1)
    return np.where(ranges > np.finfo(float).eps ** 0.5, ranges, 1.0)  # but for rounding
