# SPDX-License-Identifier: BSD-3-Clause
"""Predicts how precisely a camera locates a roundel: the Cramer-Rao bound of its edges, which our detector attains.

A point of an edge with contrast c, blur b and noise sigma_n determines its position along the edge's normal with the
information c^2 / (2 sqrt(pi) b sigma_n^2) for each pixel of the edge's length. The pose of the disc moves every point
of both circles; the sum over both circles is the information on the pose. docs/sensor_model.md has the derivation.
"""

from dataclasses import dataclass

import numpy as np

from camera_node.arrays import Array
from camera_node.geometry.lens import Lens
from camera_node.sensor_model.imaging import Imaging
from camera_node.sensor_model.operational_space import Pattern

EDGE_POINTS = 32  # of each circle
RATIO_SIGMA = 0.002  # of d_i / d_o between prints of one kind, as in the detector's fit
NORMAL_SIGMA = 0.5  # rad; prior that keeps frontal discs regular, whose normal has no effect to first order
LEVEL_WIDTH = 2.5  # blurs from an edge up to which pixels determine the grey levels
PIXEL_VARIANCE = 1 / 12  # of a pixel's own width, square pixels
ROUNDING = 1 / 12  # variance of rounding to 8 bits, square grey levels
# Columns of the information matrix: position, normal, ratio d_i / d_o, and the grey levels of paper and ink.
POSITION, NORMAL, RATIO, BRIGHT, DARK = slice(0, 3), slice(3, 5), 5, 6, 7
UNKNOWNS = 8


@dataclass(frozen=True, slots=True, eq=False)
class PredictedPrecision:
    """Precision of one view of each of N roundels.

    Attributes:
        position_cov: (N, 3, 3) covariance of the disc's centre, camera frame, square metres.
        centre_cov_px: (N, 2, 2) covariance of the image of the disc's centre, square pixels.
        distance_sigma_m: (N,) standard deviation of the distance from the camera, metres.
        normal_sigma_rad: (N,) of the normal about its worse axis, given the right one of both solutions; at most
            `NORMAL_SIGMA`. To first order: the normal of a frontal roundel is better than this.
    """

    position_cov: Array
    centre_cov_px: Array
    distance_sigma_m: Array
    normal_sigma_rad: Array


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
    return _summarize(cov, position, J_centre)


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
    # The area of each level for each pixel of an edge's length, beyond the edge up to the next one.
    ring, hole = outer.by_radius * (1 - ratio) / 2, inner.by_radius * ratio / 2
    margin = outer.by_radius * (pattern.d / pattern.d_o - 1)
    total = np.zeros((len(outer.blur_px), UNKNOWNS, UNKNOWNS))
    for edge, sign, inside in ((outer, 1.0, margin), (inner, -1.0, hole)):
        J = np.zeros((*edge.blur_px.shape, 6))
        J[..., :5] = edge.by_pose
        if edge is inner:
            J[..., RATIO] = edge.by_radius
        weight = imaging.contrast**2 / (2 * np.sqrt(np.pi) * edge.blur_px) * edge.length_px
        total[:, :6, :6] += np.einsum("nm,nmi,nmj->nij", weight, J, J)
        # An outward displacement of the outer edge darkens by c phi(delta / b) / b; the share of a level there is the
        # normal distribution. The integral of their product is c / 2.
        cross = -sign * imaging.contrast / 2 * np.einsum("nm,nmi->ni", edge.length_px, J)
        for level, width in ((BRIGHT, inside), (DARK, ring)):
            reach = np.minimum(np.abs(width), LEVEL_WIDTH * edge.blur_px)
            total[:, :6, level] += cross
            total[:, level, level] += (edge.length_px * reach).sum(axis=1)
    total[:, BRIGHT:, :6] = total[:, :6, BRIGHT:].mT
    total /= noise
    total[:, RATIO, RATIO] += RATIO_SIGMA**-2
    total[:, [3, 4], [3, 4]] += NORMAL_SIGMA**-2
    return total


def _summarize(cov: Array, position: Array, J: Array) -> PredictedPrecision:
    p = cov[:, POSITION, POSITION]
    line = position / np.linalg.norm(position, axis=1, keepdims=True)
    return PredictedPrecision(
        p,
        J @ p @ J.mT,
        np.sqrt(np.einsum("ni,nij,nj->n", line, p, line)),
        np.sqrt(np.linalg.eigvalsh(cov[:, NORMAL, NORMAL])[:, -1]),
    )
