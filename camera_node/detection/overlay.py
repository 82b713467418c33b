# SPDX-License-Identifier: BSD-3-Clause
"""Draws detected roundels on their image."""

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from camera_node.detection.refusals import RefusedRing
from camera_node.detection.roundels import Roundel, Roundels
from camera_node.foundation.arrays import Array

GREEN, RED, AMBER = (60, 200, 60), (40, 40, 230), (58, 166, 240)
MIN_RADIUS_PX = 3.0  # of an ellipse in a preview
SHIFT = 4  # fractional bits of OpenCV's coordinates: 1/16 pixel


def draw_roundels(image: NDArray[np.uint8], roundels: Roundels) -> NDArray[np.uint8]:
    """Copy a grey image (h, w) to BGR (h, w, 3) and draw the outer ellipse, centre and number of each roundel."""
    canvas = cv2.cvtColor(image, cv2.COLOR_GRAY2BGR)
    for k, roundel in enumerate(roundels):
        _draw(canvas, roundel, str(k if roundel.id is None else roundel.id))
    return canvas.astype(np.uint8, copy=False)


def draw_refused(canvas: NDArray[np.uint8], rings: Sequence[RefusedRing]) -> None:
    """Draw refused rings on a BGR image (h, w, 3): their ellipses and the reasons."""
    for ring in rings:
        u, v, a, b = (int(x) for x in np.rint(np.concatenate([ring.uv, ring.axes_px / 2]) * 2**SHIFT))
        angle = float(np.degrees(ring.angle_rad))
        cv2.ellipse(canvas, (u, v), (a, b), angle, 0, 360, AMBER, 1, cv2.LINE_AA, SHIFT)
        at = (int(ring.uv[0] - ring.axes_px[0] / 2), int(ring.uv[1] + ring.axes_px[0] / 2 + 12))
        cv2.putText(
            canvas, ring.reason.name.lower(), at, cv2.FONT_HERSHEY_SIMPLEX, 0.4, AMBER, 1, cv2.LINE_AA
        )


def draw_preview(
    image: NDArray[np.uint8], roundels: Roundels, mask: Sequence[ArrayLike], max_side: int
) -> NDArray[np.uint8]:
    """Reduce a grey image (h, w) to BGR of at most `max_side` rows and columns; roundels green, mask amber.

    The reduction is by a whole number, which OpenCV averages ten times as fast as by another.
    """
    height, width = image.shape
    k = -(-max(height, width) // max_side)
    size = (max(1, width // k), max(1, height // k))
    whole = image[: size[1] * k, : size[0] * k]
    small = cv2.resize(whole, size, interpolation=cv2.INTER_AREA)
    canvas = cv2.cvtColor(small, cv2.COLOR_GRAY2BGR)
    for polygon in mask:
        corners = np.rint(_reduced(polygon, k) * 2**SHIFT).astype(np.int32)
        cv2.polylines(canvas, [corners], True, AMBER, 1, cv2.LINE_AA, SHIFT)
    axes = np.where(np.isfinite(roundels.axes_px), roundels.axes_px, 0.0)
    for uv, radii, angle in zip(
        _reduced(roundels.uv, k), axes / (2 * k), np.degrees(roundels.angle_rad), strict=True
    ):
        u, v, a, b = (int(x) for x in np.rint([*uv, *np.maximum(radii, MIN_RADIUS_PX)] * np.array(2**SHIFT)))
        cv2.ellipse(canvas, (u, v), (a, b), float(np.nan_to_num(angle)), 0, 360, GREEN, 2, cv2.LINE_AA, SHIFT)
    return canvas.astype(np.uint8, copy=False)


def _reduced(uv: ArrayLike, k: int) -> Array:
    """Pixels (N, 2) in an image that is smaller by k; pixel (0, 0) is the centre of the top-left pixel of both."""
    return (np.asarray(uv, float).reshape(-1, 2) + 0.5) / k - 0.5


def _draw(canvas: np.ndarray, roundel: Roundel, label: str) -> None:
    u, v = (int(x) for x in np.rint(roundel.uv * 2**SHIFT))
    if np.isfinite(roundel.axes_px).all():
        a, b = (int(x) for x in np.rint(roundel.axes_px / 2 * 2**SHIFT))
        angle = float(np.degrees(roundel.angle_rad))
        cv2.ellipse(canvas, (u, v), (a, b), angle, 0, 360, GREEN, 1, cv2.LINE_AA, SHIFT)
    cv2.circle(canvas, (u, v), 2**SHIFT, RED, -1, cv2.LINE_AA, SHIFT)
    at = (int(roundel.uv[0]) + 5, int(roundel.uv[1]) - 5)
    cv2.putText(canvas, label, at, cv2.FONT_HERSHEY_SIMPLEX, 0.4, RED, 1, cv2.LINE_AA)
