# SPDX-License-Identifier: BSD-3-Clause
"""The pose of a disc by least squares to all that one view tells of it: both edges' ellipses at once.

A pose has five unknowns, and the fit of a roundel seven that follow from them: the outer ellipse and where the disc's
own centre projects. What they contradict each other in is noise, and their covariance tells whose.
"""

import numpy as np

from camera_node.arrays import Array
from camera_node.geometry.lens import Lens

STEPS = 4  # of Gauss and Newton; both poses of the conic are near
STEP = 0.2  # radians, and of the distance: no step is longer


def shape_of(dual: Array) -> Array:
    """What dual conics (..., 3, 3) say, (..., 5): the ellipse's centre x, y and its shape S = A A^T, xx, xy, yy."""
    D = dual / dual[..., 2:, 2:]
    x, y = D[..., 0, 2], D[..., 1, 2]
    S = x * x - D[..., 0, 0], x * y - D[..., 0, 1], y * y - D[..., 1, 1]
    return np.stack([x, y, *S], axis=-1)


def covariance_through(lens: Lens, ellipses: Array, covariance: Array) -> Array:
    """Of the centre, of S and of where the disc's centre projects (N, 7, 7), all in the plane at distance one.

    `ellipses` are (N, 5) u, v, major, minor, angle and `covariance` (N, 7, 7) is `DetectedRoundels.pose_cov`. The
    lens is taken to be affine over a roundel, which is near enough for a covariance.
    """
    J = _lens_slope(lens, ellipses[:, :2])
    A = _root(ellipses)
    T = np.zeros((len(ellipses), 7, 7))
    T[:, :2, :2] = T[:, 5:, :2] = T[:, 5:, 5:] = J
    for k, (i, j) in enumerate(((0, 0), (0, 1), (1, 1))):
        dA = np.zeros((2, 2))
        dA[i, j] = dA[j, i] = 1
        dS = J @ (dA @ A + A @ dA) @ J.mT
        T[:, 2:5, 2 + k] = dS[:, [0, 0, 1], [0, 1, 1]]
    return T @ covariance @ T.mT


def _lens_slope(lens: Lens, uv: Array) -> Array:
    """(N, 2, 2) derivative of the undistorted plane's x, y by raw pixels, over one pixel."""
    half = np.array([[0.5, 0.0], [-0.5, 0.0], [0.0, 0.5], [0.0, -0.5]])
    xy = lens.normalise((uv[:, None] + half).reshape(-1, 2)).reshape(-1, 4, 2)
    return np.stack([xy[:, 0] - xy[:, 1], xy[:, 2] - xy[:, 3]], axis=-1)


def _root(ellipses: Array) -> Array:
    """(N, 2, 2) the symmetric A of ellipses centre + A q, |q| = 1."""
    c, s = np.cos(ellipses[:, 4]), np.sin(ellipses[:, 4])
    R = np.moveaxis(np.array([[c, -s], [s, c]]), 2, 0)
    return R @ (ellipses[:, 2:4, None] / 2 * R.mT)


def adjust(
    position: Array, normal: Array, radius: float, seen: Array, covariance: Array
) -> tuple[Array, Array, Array]:
    """The poses of least squares near given ones.

    Args:
        position, normal: (N, 3) to begin with, camera frame; they stay where there is no better one.
        seen: (N, 7) the ellipse's centre, S and the disc's centre, in the plane at distance one.
        covariance: (N, 7, 7) of `seen`.

    Returns:
        position, normal: (N, 3).
        chi2: (N,) what is left, of two degrees.
    """
    to_white = np.linalg.inv(np.linalg.cholesky(covariance))
    c, n = position, normal
    for _ in range(STEPS):
        predicted, J, t = _predict(c, n, radius)
        J = to_white @ J
        left = to_white @ (seen - predicted)[..., None]
        delta = np.linalg.solve(J.mT @ J, J.mT @ left)[..., 0]
        delta *= np.minimum(1, STEP / np.abs(delta).max(axis=1, keepdims=True))
        c = c + np.linalg.norm(c, axis=1, keepdims=True) * delta[:, :3]
        n = n + (t @ delta[:, 3:, None])[..., 0]
        n /= np.linalg.norm(n, axis=1, keepdims=True)
    valid = (c[:, 2:] > 0) & ((n * c).sum(axis=1, keepdims=True) < 0)
    c, n = np.where(valid, c, position), np.where(valid, n, normal)
    left = to_white @ (seen - _predict(c, n, radius)[0])[..., None]
    return c, n, (left**2).sum(axis=(1, 2))


def _predict(c: Array, n: Array, radius: float) -> tuple[Array, Array, Array]:
    """What a disc shows (N, 7), its derivative (N, 7, 5), and two directions (N, 3, 2) across the normal.

    The five are the position over the distance, and the normal along these directions.
    """
    dual = _outer(c, c) - radius**2 * (np.eye(3) - _outer(n, n))
    t = _across(n)
    d_c = np.linalg.norm(c, axis=1)[:, None, None] * np.eye(3)
    d_dual = [_twice(c, d_c[:, :, k]) for k in range(3)]
    d_dual += [radius**2 * _twice(n, t[:, :, k]) for k in range(2)]
    d_shape = [_shape_slope(dual, change) for change in d_dual]
    z = c[:, 2:]
    centre = c[:, :2] / z
    d_centre = (d_c[:, :2] - centre[:, :, None] * d_c[:, 2:]) / z[:, None]
    J = np.zeros((len(c), 7, 5))
    J[:, :5] = np.stack(d_shape, axis=-1)
    J[:, 5:, :3] = d_centre
    return np.concatenate([shape_of(dual), centre], axis=1), J, t


def _across(n: Array) -> Array:
    """(N, 3, 2) two directions at right angles to the normals and to each other (Duff et al., JCGT 6, 2017)."""
    x, y, z = n.T
    sign = np.copysign(1.0, z)
    a = -1 / (sign + z)
    b = x * y * a
    return np.moveaxis(
        np.array([[1 + sign * x * x * a, b], [sign * b, sign + y * y * a], [-sign * x, -y]]), 2, 0
    )


def _shape_slope(dual: Array, change: Array) -> Array:
    """The change (N, 5) of `shape_of` with a small change (N, 3, 3) of the dual conics."""
    z = dual[:, 2:, 2:]
    D = dual / z
    dD = (change - D * change[:, 2:, 2:]) / z
    (x, y), (dx, dy) = D[:, :2, 2].T, dD[:, :2, 2].T
    dS = 2 * x * dx - dD[:, 0, 0], x * dy + y * dx - dD[:, 0, 1], 2 * y * dy - dD[:, 1, 1]
    return np.stack([dx, dy, *dS], axis=-1)


def _outer(a: Array, b: Array) -> Array:
    return a[:, :, None] * b[:, None]


def _twice(a: Array, b: Array) -> Array:
    return _outer(a, b) + _outer(b, a)
