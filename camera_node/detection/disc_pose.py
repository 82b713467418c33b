# SPDX-License-Identifier: BSD-3-Clause
"""Computes the two poses of a disc that explain its ellipse in one view and its known diameter.

Least squares adjusts each pose to the outer ellipse and to the image of the disc's centre: five parameters for seven
measurements, whose covariance weights their residuals.

See docs/design/detector_model.md, section 9.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from camera_node import _core
from camera_node.detection.roundels import DetectedRoundels, Roundel, Roundels
from camera_node.foundation.arrays import Array
from camera_node.geometry.lens import Lens
from camera_node.geometry.outline import disc_pictures, ellipses_of, half_axes_of

BOUNDARY = 24  # points of an ellipse that are undistorted
# Mean squared error of small roundels' offsets relative to their covariance, which is of first order (measured).
SCATTER = 1.5
AROUND = np.linspace(0, 2 * np.pi, BOUNDARY, endpoint=False)
STEPS = 4  # Gauss-Newton iterations; the poses from the conic are close to the solution
MAX_SIGMA = np.pi / 2  # of a normal, radians: nothing is known
STEP = 0.2  # largest step: of the normal in radians, of the position relative to the distance


@dataclass(frozen=True, slots=True)
class DiscPose:
    """One pose of a disc that explains an ellipse.

    Attributes:
        position_m: (3,) the disc's centre, camera frame.
        normal: (3,) unit vector out of the printed side, towards the camera.
        centre_uv: (2,) image of the disc's centre, raw pixels.
        probability: probability of this pose compared with the other one.
    """

    position_m: Array
    normal: Array
    centre_uv: Array
    probability: float


@dataclass(frozen=True, slots=True, eq=False)
class DiscPoses:
    """Both poses of N discs, the likelier first; rows are NaN where the lens has no inverse at the ellipse.

    Shapes: position_m and normal (N, 2, 3), centre_uv (N, 2, 2), probability (N, 2); as in `DiscPose`. `cov`
    (N, 2, 3, 3) is the covariance of `position_m`, square metres, and `normal_sigma` (N, 2) the standard deviation of
    `normal`, radians; NaN unless the roundels are `DetectedRoundels`.
    """

    position_m: Array
    normal: Array
    centre_uv: Array
    probability: Array
    cov: Array
    normal_sigma: Array

    def __len__(self) -> int:
        return len(self.position_m)

    def __iter__(self) -> Iterator[tuple[DiscPose, DiscPose] | None]:
        return (self[k] for k in range(len(self)))

    def __getitem__(self, k: int) -> tuple[DiscPose, DiscPose] | None:
        """Both poses of one disc; None where the row is NaN."""
        if not np.isfinite(self.position_m[k]).all():
            return None
        columns = (self.position_m[k], self.normal[k], self.centre_uv[k], self.probability[k])
        first, second = (DiscPose(p, n, uv, float(odds)) for p, n, uv, odds in zip(*columns, strict=True))
        return first, second


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


@dataclass(frozen=True, slots=True)
class _Offsets:
    """Measured positions of N discs' centres: `offset_px` (N, 2) and `pose_cov` (N, 7, 7) of `DetectedRoundels`."""

    offset_px: Array
    pose_cov: Array


def locate(roundel: Roundel, lens: Lens, diameter_m: float) -> tuple[DiscPose, DiscPose] | None:
    """Compute both poses of one disc, as in `locate_all`; None where the lens has no inverse."""
    ellipse = np.array([[*roundel.uv, *roundel.axes_px, roundel.angle_rad]])
    offsets = None
    if roundel.offset_px is not None and roundel.pose_cov is not None:
        offsets = _Offsets(roundel.offset_px[None], roundel.pose_cov[None])
    return _locate(ellipse, lens, diameter_m, offsets)[0]


def locate_all(roundels: Roundels, lens: Lens, diameter_m: float) -> DiscPoses:
    """Compute both poses of each disc of outer diameter `diameter_m`, the likelier first.

    Points of each ellipse are undistorted and a conic is fitted to them, because the image of a circle through a lens
    with distortion is not an ellipse. Decomposing the conic gives both poses (Forsyth et al. 1991; Safaee-Rad et al.
    1992).

    The outer ellipse does not distinguish the two poses; the image of the disc's own centre does. For
    `DetectedRoundels`, both poses are adjusted to the ellipse and the measured offset, and their probabilities follow
    from the remaining chi-square with two degrees of freedom, divided by `SCATTER`. Otherwise both are 0.5.
    """
    ellipses = np.column_stack([roundels.uv, roundels.axes_px, roundels.angle_rad])
    measured = isinstance(roundels, DetectedRoundels)
    return _locate(
        ellipses, lens, diameter_m, _Offsets(roundels.offset_px, roundels.pose_cov) if measured else None
    )


def distance_by_principal_axis(roundel: Roundel, lens: Lens, diameter_m: float) -> float:
    """Distance of one disc's centre, metres, as in `distances_by_principal_axis`; NaN without an inverse."""
    ellipse = np.array([[*roundel.uv, *roundel.axes_px, roundel.angle_rad]])
    return float(_distances_by_principal_axis(ellipse, lens, diameter_m)[0])


def distances_by_principal_axis(roundels: Roundels, lens: Lens, diameter_m: float) -> Array:
    """Distances (N,) of discs' centres from the camera, metres, by the ellipses' major axes; NaN without an inverse.

    Section III-C of Faigl et al. (ICRA 2013): one diameter of a slanted disc is perpendicular to the line of sight and
    appears as the ellipse's major axis, so that L = d_o / major. Here the axis is measured in the image plane of a
    camera of focal length one that points at the ellipse, so that lens and position in the image have no effect.

    Perspective causes a systematic error. The dual conic of a circle of radius r around (0, 0, L) that is slanted by
    theta, c c^T - r^2 (I - n n^T), has major / 2 = r / sqrt(L^2 - r^2 sin^2 theta), which gives the corrected distance
    L-hat = sqrt((d_o / major)^2 + (d_o / 2)^2 sin^2 theta), sin^2 theta = 1 - (minor / major)^2. The correction is
    derived from the geometry, as the paper's own correction was not available. The remaining error is of the order of
    (d_o / L)^4.
    """
    ellipses = np.column_stack([roundels.uv, roundels.axes_px, roundels.angle_rad])
    return _distances_by_principal_axis(ellipses, lens, diameter_m)


def _distances_by_principal_axis(ellipses: Array, lens: Lens, diameter_m: float) -> Array:
    """As `distances_by_principal_axis`, of ellipses (N, 5)."""
    n = len(ellipses)
    points = np.concatenate([ellipses[:, None, :2], _boundaries(ellipses)], axis=1)
    rays = lens.rays(points.reshape(-1, 2)).reshape(n, 1 + BOUNDARY, 3)
    valid = np.isfinite(rays).all(axis=(1, 2))
    distances = np.full(n, np.nan)
    if not valid.any():
        return distances
    turned = rays[valid, 1:] @ _rotations_to_axis(rays[valid, 0]).mT
    minor, major = _axes(_fit_conics(turned[..., :2] / turned[..., 2:]))
    uncorrected = np.array([_core.distance_by_principal_axis(diameter_m, axis) for axis in major])
    distances[valid] = np.hypot(uncorrected, diameter_m / 2 * np.sqrt(1 - (minor / major) ** 2))
    return distances


def _locate(ellipses: Array, lens: Lens, diameter_m: float, offsets: _Offsets | None) -> DiscPoses:
    """Both poses of ellipses (N, 5): u, v, major, minor, angle."""
    n = len(ellipses)
    xy = lens.normalise(_boundaries(ellipses).reshape(-1, 2)).reshape(n, BOUNDARY, 2)
    valid = np.isfinite(xy).all(axis=(1, 2))
    position, normal = np.full((n, 2, 3), np.nan), np.full((n, 2, 3), np.nan)
    odds, cov = np.full((n, 2), 0.5), np.full((n, 2, 3, 3), np.nan)
    sigma = np.full((n, 2), np.nan)
    if valid.any():
        Q, radius = _fit_conics(xy[valid]), diameter_m / 2
        position[valid], normal[valid] = decompose(Q, radius)
        if offsets is not None:
            offsets = _Offsets(offsets.offset_px[valid], offsets.pose_cov[valid])
            both = _adjust(
                position[valid], normal[valid], radius, _measure(Q, lens, ellipses[valid], offsets)
            )
            position[valid], normal[valid] = both.position.reshape(-1, 2, 3), both.normal.reshape(-1, 2, 3)
            odds[valid], cov[valid] = _odds(both.chi2.reshape(-1, 2)), both.cov.reshape(-1, 2, 3, 3)
            sigma[valid] = both.normal_sigma.reshape(-1, 2)
    uv = lens.project(position.reshape(-1, 3)).reshape(n, 2, 2)
    pick = np.arange(n)[:, None], np.argsort(-odds, axis=1, kind="stable")
    return DiscPoses(position[pick], normal[pick], uv[pick], odds[pick], cov[pick], sigma[pick])


def _measure(Q: Array, lens: Lens, ellipses: Array, offsets: _Offsets) -> tuple[Array, Array]:
    """Measurements (N, 7) for `adjust`, and their covariances (N, 7, 7)."""
    centres = lens.normalise(ellipses[:, :2] + offsets.offset_px)
    shapes = ellipses_of(np.asarray(np.linalg.inv(Q), float))
    return np.concatenate([shapes, centres], axis=1), covariance_through(lens, ellipses, offsets.pose_cov)


def _adjust(
    position: Array, normal: Array, radius: float, measurements: tuple[Array, Array]
) -> AdjustedDiscs:
    """Adjust both poses (N, 2, 3) of each disc to its measurements (`_measure`); the result has 2 N rows."""
    measured, covariance = (np.repeat(column, 2, axis=0) for column in measurements)
    return adjust(position.reshape(-1, 3), normal.reshape(-1, 3), radius, measured, covariance)


def _boundaries(ellipses: Array) -> Array:
    """(N, BOUNDARY, 2) points of ellipses (N, 5), raw pixels."""
    circle = np.array([np.cos(AROUND), np.sin(AROUND)])
    return ellipses[:, None, :2] + (half_axes_of(ellipses[:, 2:4], ellipses[:, 4]) @ circle).mT


def _fit_conics(xy: Array) -> Array:
    """Fit conics Q (N, 3, 3), p^T Q p = 0 with signature (+, +, -), to points p = (x, y, 1) of N ellipses (N, M, 2)."""
    mean, scale = xy.mean(axis=1), xy.std(axis=(1, 2))
    x, y = np.moveaxis((xy - mean[:, None]) / scale[:, None, None], 2, 0)
    rows = np.stack([x * x, x * y, y * y, x, y], axis=-1)
    at_one = np.linalg.solve(rows.mT @ rows, rows.sum(axis=1)[..., None])[..., 0]  # rows @ at_one = 1
    a, b, c, d, e = at_one.T
    Q = np.array([[a, b / 2, d / 2], [b / 2, c, e / 2], [d / 2, e / 2, np.full_like(a, -1.0)]])
    H = np.tile(np.eye(3), (len(xy), 1, 1))
    H[:, :2, 2], H[:, 2, 2] = -mean, scale
    return H.mT @ np.moveaxis(Q, 2, 0) @ H / (scale**2)[:, None, None]


def decompose(Q: Array, radius: float) -> tuple[Array, Array]:
    """Compute positions and normals (N, 2, 3) of the circles of `radius` whose images are the conics Q (N, 3, 3).

    The dual conic of a circle's image is Q^-1 = mu (c c^T - r^2 (I - n n^T)), c its centre.
    """
    n, dual = _normals(Q), np.linalg.inv(Q)[:, None]
    towards = (dual @ n[..., None])[..., 0]  # mu (c . n) c
    t = _perpendicular(n, towards)
    mu = -np.einsum("nki,nkij,nkj->nk", t, dual, t) / radius**2
    c = towards / (mu * np.sqrt((n * towards).sum(-1) / mu))[..., None]
    c *= np.where(c[..., 2:] > 0, 1.0, -1.0)
    return c, n * np.where((n * c).sum(-1, keepdims=True) < 0, 1.0, -1.0)


def _normals(Q: Array) -> Array:
    """(N, 2, 3) unit normals of the planes that intersect the cones p^T Q p = 0 in circles, one for each solution."""
    values, v = np.linalg.eigh(Q)
    l3, l2, l1 = values.T[..., None]
    along = np.sqrt(np.maximum(l1 - l2, 0.0) / (l1 - l3)) * v[:, :, 2]
    up = np.sqrt((l2 - l3) / (l1 - l3)) * v[:, :, 0]
    return np.stack([along + up, along - up], axis=1)


def _perpendicular(n: Array, towards: Array) -> Array:
    """(N, 2, 3) unit vectors perpendicular to the normals n and to `towards`, or to n alone where both are parallel."""
    t = np.cross(n, towards / np.linalg.norm(towards, axis=-1, keepdims=True))
    t = np.where(np.linalg.norm(t, axis=-1, keepdims=True) < 1e-9, np.cross(n, [1.0, 0.0, 0.0]), t)
    return t / np.linalg.norm(t, axis=-1, keepdims=True)


def _odds(chi2: Array) -> Array:
    """Probabilities (N, 2) of two poses from their chi-square."""
    weight = np.exp(-(chi2 - chi2.min(axis=1, keepdims=True)) / 2 / SCATTER)
    return weight / weight.sum(axis=1, keepdims=True)


def _rotations_to_axis(rays: Array) -> Array:
    """(N, 3, 3) rotations that map unit rays (N, 3) to the optical axis."""
    x = np.cross([0.0, 1.0, 0.0], rays)
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    return np.stack([x, np.cross(rays, x), rays], axis=1).astype(float)


def _axes(Q: Array) -> tuple[Array, Array]:
    """Full minor and major axes, (N,) each, of ellipses with the conics (N, 3, 3)."""
    linear = Q[:, :2, 2]
    centre = np.linalg.solve(Q[:, :2, :2], -linear[..., None])[..., 0]
    level = -(Q[:, 2, 2] + (linear * centre).sum(axis=1))
    minor, major = 2 * np.sqrt(level[:, None] / np.linalg.eigvalsh(Q[:, :2, :2])[:, ::-1]).T
    return minor, major


def covariance_through(lens: Lens, ellipses: Array, covariance: Array) -> Array:
    """Transform covariances of ellipse and disc centre from raw pixels to the normalised image plane.

    `ellipses` are (N, 5) u, v, major, minor, angle and `covariance` (N, 7, 7) is `DetectedRoundels.pose_cov`. The lens
    is approximated as affine over a roundel. Returns (N, 7, 7).
    """
    J = _lens_derivative(lens, ellipses[:, :2])
    A = _symmetric_root(ellipses)
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


def _symmetric_root(ellipses: Array) -> Array:
    """(N, 2, 2) symmetric matrices A of ellipses centre + A q, |q| = 1."""
    R = half_axes_of(np.full((len(ellipses), 2), 2.0), ellipses[:, 4])
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
        predicted, J, t = disc_pictures(c / radius, n)
        J = to_white @ J
        residual = to_white @ (measured - predicted)[..., None]
        delta = np.linalg.solve(J.mT @ J, J.mT @ residual)[..., 0]
        delta *= np.minimum(1, STEP / np.abs(delta).max(axis=1, keepdims=True))
        c = c + np.linalg.norm(c, axis=1, keepdims=True) * delta[:, :3]
        n = n + (t @ delta[:, 3:, None])[..., 0]
        n /= np.linalg.norm(n, axis=1, keepdims=True)
    valid = (c[:, 2:] > 0) & ((n * c).sum(axis=1, keepdims=True) < 0)
    c, n = np.where(valid, c, position), np.where(valid, n, normal)
    predicted, J, _ = disc_pictures(c / radius, n)
    residual = to_white @ (measured - predicted)[..., None]
    return AdjustedDiscs(c, n, (residual**2).sum(axis=(1, 2)), *_precision(c, to_white @ J))


def _precision(c: Array, J: Array) -> tuple[Array, Array]:
    """Covariances (N, 3, 3) of positions c (N, 3), and standard deviations (N,) of normals.

    `J` are the whitened derivatives (N, 7, 5) of `disc_pictures`.
    """
    cov = np.linalg.inv(J.mT @ J)
    sigma = np.sqrt(np.linalg.eigvalsh(cov[:, 3:, 3:])[:, 1])
    return (c * c).sum(axis=1)[:, None, None] * cov[:, :3, :3], np.minimum(sigma, MAX_SIGMA)
