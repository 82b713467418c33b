# SPDX-License-Identifier: BSD-3-Clause
"""D, the smallest size of a pattern's image that our detector finds, as measured.

Measured by `python -m tests.benchmarks.paper threshold`, which prints these tables: roundels on cluttered ground with
the card's default margin, found in 99 % of new images. docs/sensor_model.md shows the measurement.
"""

import numpy as np

from camera_node.arrays import Array

# Smallest major axis, pixels, by the standard deviation of the lens's blur, pixels, of frontal roundels.
BLUR_PX = (0.4, 0.7, 1.0, 1.5, 2.0)
SMALLEST_BY_BLUR_PX = (10.5, 11.5, 16.5, 27.0, 38.0)
# Smallest major axis relative to that of a frontal roundel, by slant, degrees. At 75 degrees none is found up to 60 px.
SLANT_DEG = (0.0, 30.0, 45.0, 60.0, 70.0)
RELATIVE_BY_SLANT = (1.0, 1.0, 1.13, 1.6, 3.2)
MAX_SLANT_DEG = 72.0
# A roundel that moves by more than this share of its diameter during the exposure counts as moving. Of moving ones,
# nine in ten are found in a first frame if they are as large as this and move by no more than this many diameters.
MOVING_SHARE, MOVING_PX, LONGEST_SHARE = 0.1, 20.0, 0.75
# Share of the diameter that the image's border may cut off; 14 px and more were found in all images.
CUT_SHARE = 0.1
MAX_DIAMETER_PX = 400.0  # the detector's default setting
MIN_CONTRAST = 25.0  # grey levels, the detector's default setting


def smallest_major_px(slant_rad: Array | float, blur_px: float) -> Array:
    """The smallest major axis of a roundel's outer ellipse that the detector finds, pixels.

    Linear between measured values, constant below the least blur, proportional to the blur beyond the largest one.

    Args:
        slant_rad: (...) angle between the printed side's normal and the line of sight, radians, as it appears in the
            image: the cosine is the ratio of the axes.
        blur_px: standard deviation of the lens's blur, pixels.

    Returns:
        (...) pixels; infinite beyond the largest slant.
    """
    slant = np.degrees(np.asarray(slant_rad, float))
    frontal = float(np.interp(blur_px, BLUR_PX, SMALLEST_BY_BLUR_PX))
    frontal *= max(1.0, blur_px / BLUR_PX[-1])
    # Beyond the last measured slant, the minor axis stays the same.
    last = np.cos(np.radians(SLANT_DEG[-1])) / np.maximum(np.cos(np.radians(slant)), 1e-9)
    relative = np.interp(slant, SLANT_DEG, RELATIVE_BY_SLANT) * np.maximum(last, 1.0)
    return np.where(slant <= MAX_SLANT_DEG, frontal * relative, np.inf)


def threshold_D(slant_rad: Array | float, blur_px: float) -> Array:
    """D of the paper's model, (...) pixels: the smallest minor axis that the detector finds."""
    return smallest_major_px(slant_rad, blur_px) * np.cos(slant_rad)
