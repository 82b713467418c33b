# SPDX-License-Identifier: BSD-3-Clause
"""A picture of one roundel."""

import cv2
import numpy as np

CENTRE = (160.25, 120.5)


def render() -> np.ndarray:
    """A frontal roundel of 48 px at CENTRE on a white card, drawn 16 times finer, averaged and blurred."""
    scale, grey = 16, np.full((240 * 16, 320 * 16), 90, np.uint8)
    u, v = ((c + 0.5) * scale - 0.5 for c in CENTRE)
    for diameter, level in ((62, 230), (48, 30), (28.8, 230)):
        cv2.circle(grey, (round(u), round(v)), round(diameter * scale / 2), level, -1)
    return cv2.GaussianBlur(cv2.resize(grey, (320, 240), interpolation=cv2.INTER_AREA), (0, 0), 0.7)
