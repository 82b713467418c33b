# SPDX-License-Identifier: BSD-3-Clause
"""Where a roundel stands before one camera: an ellipse and a known diameter leave two poses."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from camera_node.lens import Lens
from camera_node.roundels import Roundel

Array = NDArray[np.float64]
BOUNDARY = 64  # points of the ellipse that are taken through the lens


@dataclass(frozen=True, slots=True)
class DiscPose:
    """One pose of a disc that explains an ellipse.

    Attributes:
        position_m: (3,) the disc's centre, camera frame.
        normal: (3,) unit vector out of the printed side, towards the camera.
        centre_uv: (2,) raw pixels where the disc's centre projects.
        probability: that this is the pose rather than the other one.
    """

    position_m: Array
    normal: Array
    centre_uv: Array
    probability: float


def locate(
    roundel: Roundel,
    lens: Lens,
    diameter_m: float,
    offset: tuple[ArrayLike, ArrayLike] | None = None,
) -> tuple[DiscPose, DiscPose] | None:
    """Both poses of a disc of outer diameter `diameter_m`, the likelier first.

    The ellipse's boundary goes through the lens; the conic there is decomposed (Forsyth et al. 1991; Safaee-Rad et
    al. 1992). The outer ellipse does not tell the two poses apart. Where the disc's centre projects does: the
    probability is that of chi-square with two degrees of the measured `offset` from the ellipse's centre (2,) and its
    covariance (2, 2), as `Detector.disc_offsets` gives them. Without it both are 0.5.

    Returns:
        None where the lens has no inverse at the ellipse.
    """
    xy = lens.normalise(_boundary(roundel))
    if not np.isfinite(xy).all():
        return None
    Q = _fit_conic(xy)
    poses = [_pose(n, Q, diameter_m / 2) for n in _normals(Q)]
    uv = lens.project([position for position, _ in poses])
    odds = np.array([0.5, 0.5]) if offset is None else _odds(uv - roundel.uv, offset[0], offset[1])
    first, second = np.argsort(-odds, kind="stable")
    both = [DiscPose(p, n, at, float(odd)) for (p, n), at, odd in zip(poses, uv, odds, strict=True)]
    return both[first], both[second]


def _boundary(roundel: Roundel) -> Array:
    """(N, 2) raw pixels around the outer ellipse."""
    t = np.linspace(0, 2 * np.pi, BOUNDARY, endpoint=False)
    c, s = np.cos(roundel.angle_rad), np.sin(roundel.angle_rad)
    along, across = np.column_stack([np.cos(t), np.sin(t)]).T * roundel.axes_px[:, None] / 2
    return roundel.uv + np.column_stack([c * along - s * across, s * along + c * across])


def _fit_conic(xy: Array) -> Array:
    """Symmetric Q (3, 3) with p^T Q p = 0 for the points p = (x, y, 1) of an ellipse, signature (+, +, -)."""
    mean, scale = xy.mean(axis=0), xy.std()
    x, y = ((xy - mean) / scale).T
    a, b, c, d, e = np.linalg.lstsq(np.column_stack([x * x, x * y, y * y, x, y]), np.ones(len(x)))[0]
    H = np.array([[1, 0, -mean[0]], [0, 1, -mean[1]], [0, 0, scale]]) / scale
    return H.T @ np.array([[a, b / 2, d / 2], [b / 2, c, e / 2], [d / 2, e / 2, -1.0]]) @ H


def _normals(Q: Array) -> Array:
    """(2, 3) unit normals of the planes that cut the cone p^T Q p = 0 in circles, one a solution."""
    (l3, l2, l1), v = np.linalg.eigh(Q)
    along = np.sqrt(max(l1 - l2, 0.0) / (l1 - l3)) * v[:, 2]
    up = np.sqrt((l2 - l3) / (l1 - l3)) * v[:, 0]
    return np.array([along + up, along - up])


def _pose(n: Array, Q: Array, radius: float) -> tuple[Array, Array]:
    """Position and normal of the circle of `radius` in the plane of normal `n` (up to its sign).

    The dual conic of a circle's image is Q^-1 = mu (c c^T - r^2 (I - n n^T)), c its centre.
    """
    dual = np.linalg.inv(Q)
    towards = dual @ n  # mu (c . n) c
    t = np.cross(n, towards / np.linalg.norm(towards))  # at right angles to n and c
    if np.linalg.norm(t) < 1e-9:
        t = np.cross(n, [1.0, 0.0, 0.0])
    t /= np.linalg.norm(t)
    mu = -(t @ dual @ t) / radius**2
    c = towards / (mu * np.sqrt(n @ towards / mu))
    c = c if c[2] > 0 else -c
    return c, n if n @ c < 0 else -n


def _odds(predicted: Array, offset: ArrayLike, cov: ArrayLike) -> Array:
    """Probabilities (2,) of predicted offsets (2, 2) by their chi-square."""
    error = predicted - np.asarray(offset, float)
    chi2 = np.einsum("ki,ij,kj->k", error, np.linalg.inv(np.asarray(cov, float)), error)
    weight = np.exp(-(chi2 - chi2.min()) / 2)
    return weight / weight.sum()
