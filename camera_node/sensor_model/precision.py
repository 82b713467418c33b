# SPDX-License-Identifier: BSD-3-Clause
"""Predicts how precisely a camera locates a roundel: the Cramer-Rao bound of its edges, which our detector attains.

A point of an edge with contrast c, blur b and noise sigma_n determines its position along the edge's normal with the
information c^2 / (2 sqrt(pi) b sigma_n^2) for each pixel of the edge's length. The pose of the disc moves every point
of both circles; the sum over both circles is the information on the pose. docs/design/sensor_model.md derives it.
"""

from dataclasses import dataclass

import numpy as np

from camera_node.foundation.arrays import Array
from camera_node.geometry.lens import Lens
from camera_node.geometry.outline import disc_pictures
from camera_node.geometry.pose import skew
from camera_node.sensor_model.imaging import Imaging
from camera_node.sensor_model.operational_space import Pattern

EDGE_POINTS = 32  # of each circle
RATIO_SIGMA = 0.002  # of d_i / d_o between prints of one kind, as in the detector's fit
NORMAL_SIGMA = 0.5  # rad; prior that keeps frontal discs regular, whose normal has no effect to first order
ACROSS_POINTS = 8  # of the quadrature across an edge
LEVEL_WIDTH = 2.5  # blurs from an edge up to which pixels determine the grey levels
PIXEL_VARIANCE = 1 / 12  # of a pixel's own width, square pixels
ROUNDING = 1 / 12  # variance of rounding to 8 bits, square grey levels
# Columns of the information matrix: position, two of the normal, ratio d_i / d_o, and the grey levels of paper and ink.
POSITION, RATIO, BRIGHT = slice(0, 3), 5, 6
UNKNOWNS = 8


@dataclass(frozen=True, slots=True, eq=False)
class PredictedPrecision:
    """Precision of one view of each of N roundels.

    Attributes:
        position_cov: (N, 3, 3) covariance of the disc's centre, camera frame, square metres.
        centre_cov_px: (N, 2, 2) covariance of the image of the disc's centre, square pixels.
        ellipse_cov_px: (N, 2, 2) covariance of the outer ellipse's centre, which detections hold, square pixels. Unlike
            the disc's own centre it does not depend on the normal's uncertainty.
        distance_sigma_m: (N,) standard deviation of the distance from the camera, metres.
    """

    position_cov: Array
    centre_cov_px: Array
    ellipse_cov_px: Array
    distance_sigma_m: Array


@dataclass(frozen=True, slots=True, eq=False)
class _Edge:
    """Points of one circle of N discs: their displacements, blurs and lengths in the image.

    Attributes:
        by_pose: (N, M, 5) displacement along the edge's normal by position (3) and normal (2), pixels.
        by_radius: (N, M) displacement by the radius in units of d_o / 2, pixels.
        blur_px: (N, M) standard deviation of the blur across the edge.
        length_px: (N, M) length of the edge that a point stands for.
    """

    by_pose: Array
    by_radius: Array
    blur_px: Array
    length_px: Array


def predict_precision(
    lens: Lens,
    pattern: Pattern,
    position_m: Array,
    normal: Array,
    imaging: Imaging,
    velocity_mps: Array | None = None,
) -> PredictedPrecision:
    """Predict the precision of roundels at positions (N, 3) with normals (N, 3), camera frame, metres.

    Results are NaN for positions that are not in front of the camera. Whether the camera detects a roundel is not
    considered; see `visibility.is_detected`.

    Args:
        lens: the camera.
        pattern: the print. The edge of its card is not used, because it may be invisible on a white ground.
        position_m, normal: (N, 3) centres, and unit normals out of the printed side.
        imaging: blur, contrast, noise and exposure.
        velocity_mps: (N, 3) velocities relative to the camera; none unless given.
    """
    position, normal = np.atleast_2d(position_m).astype(float), np.atleast_2d(normal).astype(float)
    J_centre = lens.project_with_jacobian(position)[1]
    motion = np.zeros((len(position), 2))
    if velocity_mps is not None:
        motion = (J_centre @ np.atleast_2d(velocity_mps)[..., None])[..., 0] * imaging.exposure_s
    frame = _disc_frames(normal)
    outer, inner = (
        _trace_edge(lens, position, frame, (pattern.d_o / 2, ratio), (imaging, motion))
        for ratio in (1.0, pattern.d_i / pattern.d_o)
    )
    information = _information(outer, inner, pattern, imaging)
    known = np.isfinite(information).all(axis=(1, 2))
    cov = np.full_like(information, np.nan)
    cov[known] = np.linalg.inv(information[known])
    to_ellipse = _ellipse_centre_jacobian(lens, pattern.d_o / 2, position, frame)
    return _summarize(cov, position, J_centre, to_ellipse)


def _disc_frames(normal: Array) -> Array:
    """(N, 3, 3) rotations with columns e1, e2, n."""
    n = normal / np.linalg.norm(normal, axis=1, keepdims=True)
    aside = np.where(np.abs(n[:, :1]) < 0.9, [[1.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]])
    e1 = np.cross(n, aside)
    e1 /= np.linalg.norm(e1, axis=1, keepdims=True)
    return np.stack([e1, np.cross(n, e1), n], axis=-1)


def _trace_edge(
    lens: Lens, position: Array, frame: Array, circle: tuple[float, float], light: tuple[Imaging, Array]
) -> _Edge:
    """The image of a circle; `circle` is d_o / 2 and the radius relative to it, `light` has the motion (N, 2) too."""
    (unit, ratio), (imaging, motion) = circle, light
    angle = np.linspace(0, 2 * np.pi, EDGE_POINTS, endpoint=False)
    e1, e2 = frame[:, None, :, 0], frame[:, None, :, 1]
    c, s = np.cos(angle)[:, None], np.sin(angle)[:, None]
    radial, along = c * e1 + s * e2, c * e2 - s * e1  # (N, M, 3) unit vectors
    points = position[:, None] + unit * ratio * radial
    J = lens.project_with_jacobian(points.reshape(-1, 3))[1].reshape(*points.shape[:2], 2, 3)
    tangent = unit * ratio * (J @ along[..., None])[..., 0]
    speed = np.linalg.norm(tangent, axis=-1)
    across = np.stack([tangent[..., 1], -tangent[..., 0]], axis=-1) / speed[..., None]
    by_point = (across[..., None, :] @ J)[
        ..., 0, :
    ]  # (N, M, 3) displacement of the edge by that of its point
    by_turn = np.cross(unit * ratio * radial, by_point)  # g . (w x r) = w . (r x g)
    variance = imaging.blur_px**2 + PIXEL_VARIANCE + (across @ motion[:, :, None])[..., 0] ** 2 / 12
    return _Edge(
        np.asarray(np.concatenate([by_point, by_turn @ frame[:, :, :2]], axis=-1), float),
        unit * (by_point * radial).sum(-1),
        np.sqrt(variance),
        speed * 2 * np.pi / EDGE_POINTS,
    )


def _information(outer: _Edge, inner: _Edge, pattern: Pattern, imaging: Imaging) -> Array:
    """(N, 8, 8) information of both edges on pose, ratio and levels; lengths in metres, angles in radians."""
    noise = imaging.noise**2 + ROUNDING
    ratio = pattern.d_i / pattern.d_o
    # The width of each level's area beyond an edge, up to the middle of the area between two edges.
    ring, hole = outer.by_radius * (1 - ratio) / 2, inner.by_radius * ratio / 2
    margin = outer.by_radius * (pattern.d / pattern.d_o - 1)
    total = np.zeros((len(outer.blur_px), UNKNOWNS, UNKNOWNS))
    for edge, sign, bright in ((outer, 1.0, margin), (inner, -1.0, hole)):
        J = np.zeros((*edge.blur_px.shape, 6))
        J[..., :5] = edge.by_pose
        if edge is inner:
            J[..., RATIO] = edge.by_radius
        across = _across_edge(edge.blur_px, np.abs(ring), np.abs(bright)) * edge.length_px[..., None, None]
        weight, contrast = across[..., 0, 0], imaging.contrast
        total[:, :6, :6] += contrast**2 * np.einsum("nm,nmi,nmj->nij", weight, J, J)
        # An outward displacement of the outer edge darkens by c phi(delta / b) / b, of the inner edge it brightens.
        total[:, :6, BRIGHT:] -= sign * contrast * np.einsum("nma,nmi->nia", across[..., 0, 1:], J)
        total[:, BRIGHT:, BRIGHT:] += across[..., 1:, 1:].sum(axis=1)
    total[:, BRIGHT:, :6] = total[:, :6, BRIGHT:].mT
    total /= noise
    total[:, RATIO, RATIO] += RATIO_SIGMA**-2
    total[:, [3, 4], [3, 4]] += NORMAL_SIGMA**-2
    return total


def _across_edge(blur_px: Array, dark_px: Array, bright_px: Array) -> Array:
    """(..., 3, 3) integrals across an edge of the products of its three derivatives, for each pixel of its length.

    The derivatives are phi(delta / b) / b by the displacement, for a contrast of 1, and the shares of the bright and of
    the dark level. A level reaches to the width of its area (...), pixels, or to `LEVEL_WIDTH` blurs.
    """
    low = -np.minimum(dark_px / blur_px, LEVEL_WIDTH)[..., None]
    high = np.minimum(bright_px / blur_px, LEVEL_WIDTH)[..., None]
    nodes, weights = np.polynomial.legendre.leggauss(ACROSS_POINTS)
    u = low + (high - low) * (nodes + 1) / 2  # in blurs
    density = np.exp(-(u**2) / 2) / np.sqrt(2 * np.pi) / blur_px[..., None]
    bright = (1 + np.tanh(np.sqrt(2 / np.pi) * (u + 0.044715 * u**3))) / 2  # the normal distribution to 3e-4
    columns = np.stack([density, bright, 1 - bright], axis=-1)
    weighted = columns * (weights * (high - low) / 2 * blur_px[..., None])[..., None]
    return columns.mT @ weighted


def _ellipse_centre_jacobian(lens: Lens, radius: float, position: Array, frame: Array) -> Array:
    """(N, 2, 5) derivative of the outer ellipse's centre by position and by rotations of the normal about e1 and e2.

    In the image plane `disc_pictures` has the derivatives, by the normal along two other directions across it.
    """
    pictures, J, tangents = disc_pictures(position / radius, frame[:, :, 2])
    by_position = J[:, :2, :3] / np.linalg.norm(position, axis=1)[:, None, None]
    turned = -skew(frame[:, :, 2]) @ frame[:, :, :2]  # changes (N, 3, 2) of the normal
    by_turn = J[:, :2, 3:] @ tangents.mT @ turned
    centre = np.column_stack([pictures[:, :2], np.ones(len(pictures))])
    J_lens = lens.project_with_jacobian(centre)[1][:, :, :2]
    return J_lens @ np.concatenate([by_position, by_turn], axis=2)


def _summarize(cov: Array, position: Array, J: Array, to_ellipse: Array) -> PredictedPrecision:
    p = cov[:, POSITION, POSITION]
    line = position / np.linalg.norm(position, axis=1, keepdims=True)
    return PredictedPrecision(
        p,
        J @ p @ J.mT,
        to_ellipse @ cov[:, :5, :5] @ to_ellipse.mT,
        np.sqrt(np.einsum("ni,nij,nj->n", line, p, line)),
    )
