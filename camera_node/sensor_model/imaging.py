# SPDX-License-Identifier: BSD-3-Clause
"""What blurs and disturbs the image of a roundel."""

from dataclasses import dataclass
from typing import Literal

import numpy as np

Ground = Literal["cluttered", "even"]


@dataclass(frozen=True, slots=True)
class Imaging:
    """Image quality; the defaults are a focused machine-vision camera in even light.

    Attributes:
        blur_px: standard deviation of the lens's blur, pixels, without a pixel's own width.
        contrast: grey levels of the paper minus those of the ink, of 255.
        noise: standard deviation of a pixel's noise, grey levels.
        exposure_s: exposure time, seconds; it has an effect on moving roundels only.
        ground: what surrounds the cards: clutter, or one grey level about midway between ink and paper.

    Raises:
        ValueError: a value is out of its range.
    """

    blur_px: float = 0.7
    contrast: float = 150.0
    noise: float = 3.0
    exposure_s: float = 0.0
    ground: Ground = "cluttered"

    def __post_init__(self) -> None:
        values = (self.blur_px, self.contrast, self.noise, self.exposure_s)
        if not (np.isfinite(values).all() and self.contrast > 0 and min(values) >= 0):
            raise ValueError(f"{self}: give finite values from 0 on, and a contrast above 0")
