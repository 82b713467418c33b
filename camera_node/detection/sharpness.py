# SPDX-License-Identifier: BSD-3-Clause
"""Measures how sharp a lens is focused, by the blur of the roundels' edges."""

import cv2
import numpy as np

from camera_node.detection.roundels import Roundels
from camera_node.foundation.arrays import Array, Grey

MAX_ROUNDELS = 3  # the largest ones are measured
MIN_RADIUS_PX = 6.0  # of the minor half axis: the edges of smaller roundels merge
REACH = 0.55  # of a profile to each side of the outer edge, in radii: it includes the inner edge and that of the card
RATIO, CARD = 0.6, 9 / 7  # diameters of inner disc and card over the outer one, unless the ratio is measured
SAMPLES = 33  # of a profile
SECTORS, PER_SECTOR = 16, 6  # of directions; the profiles of a sector are averaged
RANK = 2  # sector that counts, sharpest first: opposite ones agree, and a moving roundel is sharp across its motion
SIGMAS = np.geomspace(0.25, 6.0, 26)  # px, that are tried
INTERPOLATION_VARIANCE = (
    1 / 6
)  # square pixels, that bilinear interpolation adds to an edge, mean over its phases


def edge_blur_px(image: Grey, roundels: Roundels) -> float | None:
    """The standard deviation of the blur of the roundels' edges, pixels; None without a roundel that is large enough.

    The blur includes that of the pixels' own area, so a perfectly sharp lens has about 0.3 px. Motion blur is left out
    where a roundel moves in one direction: the sharper directions of its edge count.

    Args:
        image: (h, w) grey.
        roundels: detected in it.
    """
    minor = np.nan_to_num(roundels.axes_px[:, 1]) / 2
    largest = [k for k in np.argsort(-minor)[:MAX_ROUNDELS] if minor[k] >= MIN_RADIUS_PX]
    if not image.size or not largest:
        return None
    return float(np.median([_blur_of(image, roundels, k) for k in largest]))


def _blur_of(image: Grey, roundels: Roundels, k: int) -> float:
    """Blur of the edges of one roundel."""
    circle, supports = _directions(roundels.axes_px[k] / 2)
    profiles = _sample(image, roundels, k, circle, supports)
    ratio = roundels.ratio[k] if np.isfinite(roundels.ratio[k]) else RATIO
    sigmas = np.sort(_fit_sigmas(profiles, supports.reshape(SECTORS, PER_SECTOR).mean(axis=1), ratio))
    return float(np.sqrt(max(0.0, sigmas[RANK - 1] ** 2 - INTERPOLATION_VARIANCE)))


def _directions(radii: Array) -> tuple[Array, Array]:
    """Directions (N, 2) that parametrize an ellipse, and the distances (N,) of its tangents from its centre.

    Along the normal, the edges of the same shape scaled by r lie (1 - r) times that distance further inside.
    """
    phi = 2 * np.pi * np.arange(SECTORS * PER_SECTOR) / (SECTORS * PER_SECTOR)
    circle = np.column_stack([np.cos(phi), np.sin(phi)])
    return circle, 1 / np.linalg.norm(circle / radii, axis=1)


def _sample(image: Grey, roundels: Roundels, k: int, circle: Array, supports: Array) -> Array:
    """Mean profiles of all sectors, (SECTORS, SAMPLES) grey levels from inside to outside along the normals."""
    radii, angle = roundels.axes_px[k] / 2, roundels.angle_rad[k]
    normals = supports[:, None] * circle / radii
    steps = np.linspace(-REACH, REACH, SAMPLES)
    local = (circle * radii)[:, None] + steps[None, :, None] * (supports[:, None] * normals)[:, None]
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    at = (local @ turn.T + roundels.uv[k]).astype(np.float32)
    levels = cv2.remap(image, at[..., 0], at[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return levels.astype(float).reshape(SECTORS, PER_SECTOR, -1).mean(axis=1)


def _fit_sigmas(profiles: Array, supports: Array, ratio: float) -> Array:
    """Blur (S,) px that fits profiles (S, SAMPLES) best; the levels of white, ring and ground are free in each."""
    distances = np.linspace(-REACH, REACH, SAMPLES) * supports[:, None]  # (S, N) px from the outer edge
    at = distances[:, None, :, None] - supports[:, None, None, None] * np.array([0.0, ratio - 1, CARD - 1])
    outer, inner, card = np.moveaxis(_gaussian_cdf(at / SIGMAS[:, None, None]), -1, 0)
    A = np.stack([np.ones_like(outer), outer - inner, card], axis=-1)  # (S, sigmas, N, 3)
    y = profiles[:, None, :, None]
    normal = A.swapaxes(2, 3) @ A + 1e-6 * np.eye(3)
    residuals = y - A @ np.linalg.solve(normal, A.swapaxes(2, 3) @ y)
    return SIGMAS[(residuals[..., 0] ** 2).sum(axis=2).argmin(axis=1)]


def _gaussian_cdf(x: Array) -> Array:
    """The normal distribution, to 1e-5 (Abramowitz and Stegun 26.2.16)."""
    z = np.abs(x)
    t = 1 / (1 + 0.33267 * z)
    tail = np.exp(-z * z / 2) * t * (0.4361836 + t * (-0.1201676 + t * 0.9372980)) / np.sqrt(2 * np.pi)
    return np.where(x > 0, 1 - tail, tail)
