# SPDX-License-Identifier: BSD-3-Clause
"""Adjusts the pose of a disc by least squares to its outer ellipse and to the image of its centre in one view.

The pose has five parameters. They determine the seven measurements: the outer ellipse (5) and the image of the disc's
own centre (2). The covariance of the measurements weights their residuals.
"""

from dataclasses import dataclass

import numpy as np

from camera_node.foundation.arrays import Array
from camera_node.geometry.lens import Lens

STEPS = 4  # Gauss-Newton iterations; the poses from the conic are close to the solution
MAX_SIGMA = np.pi / 2  # of a normal, radians: nothing is known
STEP = 0.2  # largest step: of the normal in radians, of the position relative to the distance


@dataclass(frozen=True, slots=True, eq=False)
class AdjustedDiscs:
    """Adjusted poses of N discs, camera frame.

    Attributes:
        position, normal: (N, 3).
        chi2: (N,) weighted sum of squared residuals, with two degrees of freedom.
        cov: (N, 3, 3) covariance of `position`, squared unit of `position`, to first order.
        normal_sigma: (N,) standard deviation of `normal` in its least certain direction, radians, to first order.
    """

    position: Array
    normal: Array
    chi2: Array
    cov: Array
    normal_sigma: Array


def shape_of(dual: Array) -> Array:
    """Ellipses (..., 5) of dual conics (..., 3, 3): the centre x, y and the shape S = A A^T as xx, xy, yy."""
    D = dual / dual[..., 2:, 2:]
    x, y = D[..., 0, 2], D[..., 1, 2]
    S = x * x - D[..., 0, 0], x * y - D[..., 0, 1], y * y - D[..., 1, 1]
    return np.stack([x, y, *S], axis=-1)


def covariance_through(lens: Lens, ellipses: Array, covariance: Array) -> Array:
    """Transform covariances of ellipse and disc centre from raw pixels to the normalised image plane.

    `ellipses` are (N, 5) u, v, major, minor, angle and `covariance` (N, 7, 7) is `DetectedRoundels.pose_cov`. The lens
    is approximated as affine over a roundel. Returns (N, 7, 7).
    """
    J = _lens_derivative(lens, ellipses[:, :2])
    A = _root(ellipses)
    T = np.zeros((len(ellipses), 7, 7))
    T[:, :2, :2] = T[:, 5:, :2] = T[:, 5:, 5:] = J
    for k, (i, j) in enumerate(((0, 0), (0, 1), (1, 1))):
        dA = np.zeros((2, 2))
        dA[i, j] = dA[j, i] = 1
        dS = J @ (dA @ A + A @ dA) @ J.mT
        T[:, 2:5, 2 + k] = dS[:, [0, 0, 1], [0, 1, 1]]
    return T @ covariance @ T.mT


def _lens_derivative(lens: Lens, uv: Array) -> Array:
    """(N, 2, 2) derivatives of normalised image coordinates by raw pixels, as differences over one pixel."""
    half = np.array([[0.5, 0.0], [-0.5, 0.0], [0.0, 0.5], [0.0, -0.5]])
    xy = lens.normalise((uv[:, None] + half).reshape(-1, 2)).reshape(-1, 4, 2)
    return np.stack([xy[:, 0] - xy[:, 1], xy[:, 2] - xy[:, 3]], axis=-1)


def _root(ellipses: Array) -> Array:
    """(N, 2, 2) symmetric matrices A of ellipses centre + A q, |q| = 1."""
    c, s = np.cos(ellipses[:, 4]), np.sin(ellipses[:, 4])
    R = np.moveaxis(np.array([[c, -s], [s, c]]), 2, 0)
    return R @ (ellipses[:, 2:4, None] / 2 * R.mT)


def adjust(
    position: Array, normal: Array, radius: float, measured: Array, covariance: Array
) -> AdjustedDiscs:
    """Adjust poses of discs of one radius to measurements by Gauss-Newton.

    Args:
        position, normal: (N, 3) initial poses, camera frame; returned unchanged where the result is not in front of
            the camera or faces away from it.
        radius: outer radius of the discs, in the unit of `position`.
        measured: (N, 7) the ellipse's centre, S and the disc's centre, in the normalised image plane.
        covariance: (N, 7, 7) of `measured`.
    """
    to_white = np.linalg.inv(np.linalg.cholesky(covariance))
    c, n = position, normal
    for _ in range(STEPS):
        predicted, J, t = _predict(c, n, radius)
        J = to_white @ J
        residual = to_white @ (measured - predicted)[..., None]
        delta = np.linalg.solve(J.mT @ J, J.mT @ residual)[..., 0]
        delta *= np.minimum(1, STEP / np.abs(delta).max(axis=1, keepdims=True))
        c = c + np.linalg.norm(c, axis=1, keepdims=True) * delta[:, :3]
        n = n + (t @ delta[:, 3:, None])[..., 0]
        n /= np.linalg.norm(n, axis=1, keepdims=True)
    valid = (c[:, 2:] > 0) & ((n * c).sum(axis=1, keepdims=True) < 0)
    c, n = np.where(valid, c, position), np.where(valid, n, normal)
    predicted, J, _ = _predict(c, n, radius)
    residual = to_white @ (measured - predicted)[..., None]
    return AdjustedDiscs(c, n, (residual**2).sum(axis=(1, 2)), *_precision(c, to_white @ J))


def _precision(c: Array, J: Array) -> tuple[Array, Array]:
    """Covariances (N, 3, 3) of positions c (N, 3), and standard deviations (N,) of normals.

    `J` are the whitened derivatives (N, 7, 5) of `_predict`.
    """
    cov = np.linalg.inv(J.mT @ J)
    sigma = np.sqrt(np.linalg.eigvalsh(cov[:, 3:, 3:])[:, 1])
    return (c * c).sum(axis=1)[:, None, None] * cov[:, :3, :3], np.minimum(sigma, MAX_SIGMA)


def _predict(c: Array, n: Array, radius: float) -> tuple[Array, Array, Array]:
    """Predicted measurements (N, 7), their derivatives (N, 7, 5), and two directions (N, 3, 2) across the normal.

    The five parameters are the position relative to the distance, and the normal along these directions.
    """
    dual = _outer(c, c) - radius**2 * (np.eye(3) - _outer(n, n))
    t = _tangents(n)
    d_c = np.linalg.norm(c, axis=1)[:, None, None] * np.eye(3)
    d_dual = [_symmetric_outer(c, d_c[:, :, k]) for k in range(3)]
    d_dual += [radius**2 * _symmetric_outer(n, t[:, :, k]) for k in range(2)]
    d_shape = [_shape_differential(dual, change) for change in d_dual]
    z = c[:, 2:]
    centre = c[:, :2] / z
    d_centre = (d_c[:, :2] - centre[:, :, None] * d_c[:, 2:]) / z[:, None]
    J = np.zeros((len(c), 7, 5))
    J[:, :5] = np.stack(d_shape, axis=-1)
    J[:, 5:, :3] = d_centre
    return np.concatenate([shape_of(dual), centre], axis=1), J, t


def _tangents(n: Array) -> Array:
    """(N, 3, 2) two unit vectors perpendicular to the normals and to each other (Duff et al., JCGT 6, 2017)."""
    x, y, z = n.T
    sign = np.copysign(1.0, z)
    a = -1 / (sign + z)
    b = x * y * a
    return np.moveaxis(
        np.array([[1 + sign * x * x * a, b], [sign * b, sign + y * y * a], [-sign * x, -y]]), 2, 0
    )


def _shape_differential(dual: Array, change: Array) -> Array:
    """The differential (N, 5) of `shape_of` for differentials (N, 3, 3) of the dual conics."""
    z = dual[:, 2:, 2:]
    D = dual / z
    dD = (change - D * change[:, 2:, 2:]) / z
    (x, y), (dx, dy) = D[:, :2, 2].T, dD[:, :2, 2].T
    dS = 2 * x * dx - dD[:, 0, 0], x * dy + y * dx - dD[:, 0, 1], 2 * y * dy - dD[:, 1, 1]
    return np.stack([dx, dy, *dS], axis=-1)


def _outer(a: Array, b: Array) -> Array:
    return a[:, :, None] * b[:, None]


def _symmetric_outer(a: Array, b: Array) -> Array:
    return _outer(a, b) + _outer(b, a)
