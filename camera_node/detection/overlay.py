# SPDX-License-Identifier: BSD-3-Clause
"""Draws detected roundels on their image."""

import cv2
import numpy as np
from numpy.typing import NDArray

from camera_node.detection.roundels import Roundel, Roundels

GREEN, RED = (60, 200, 60), (40, 40, 230)
SHIFT = 4  # fractional bits of OpenCV's coordinates: 1/16 pixel


def draw_roundels(image: NDArray[np.uint8], roundels: Roundels) -> NDArray[np.uint8]:
    """Copy a grey image (h, w) to BGR (h, w, 3) and draw the outer ellipse, centre and number of each roundel."""
    canvas = cv2.cvtColor(image, cv2.COLOR_GRAY2BGR)
    for k, roundel in enumerate(roundels):
        _draw(canvas, roundel, str(k if roundel.id is None else roundel.id))
    return canvas.astype(np.uint8, copy=False)


def _draw(canvas: np.ndarray, roundel: Roundel, label: str) -> None:
    u, v = (int(x) for x in np.rint(roundel.uv * 2**SHIFT))
    if np.isfinite(roundel.axes_px).all():
        a, b = (int(x) for x in np.rint(roundel.axes_px / 2 * 2**SHIFT))
        angle = float(np.degrees(roundel.angle_rad))
        cv2.ellipse(canvas, (u, v), (a, b), angle, 0, 360, GREEN, 1, cv2.LINE_AA, SHIFT)
    cv2.circle(canvas, (u, v), 2**SHIFT, RED, -1, cv2.LINE_AA, SHIFT)
    at = (int(roundel.uv[0]) + 5, int(roundel.uv[1]) - 5)
    cv2.putText(canvas, label, at, cv2.FONT_HERSHEY_SIMPLEX, 0.4, RED, 1, cv2.LINE_AA)
