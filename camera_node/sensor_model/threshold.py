# SPDX-License-Identifier: BSD-3-Clause
"""D, the smallest size of a pattern's image that our detector finds, as measured.

Measured by `python -m tests.benchmarks.paper threshold`, which prints these tables: roundels with the card's default
margin, found in new images. docs/design/sensor_model.md shows the measurement.
"""

from dataclasses import dataclass
from statistics import NormalDist

import numpy as np

from camera_node.foundation.arrays import Array
from camera_node.sensor_model.imaging import Ground, Imaging

BLUR_PX = (0.4, 0.7, 1.0, 1.5, 2.0)  # standard deviation of the lens's blur
SLANT_DEG = (0.0, 30.0, 45.0, 52.5, 60.0, 65.0, 70.0)
MAX_SLANT_DEG = 72.0  # at 75 degrees none is found up to 48 px


@dataclass(frozen=True, slots=True)
class SmallestSizes:
    """Major axes, pixels, at which a share of the roundels is found.

    Attributes:
        by_blur_px: of frontal roundels, at `BLUR_PX`.
        by_slant: at `SLANT_DEG` and a blur of 0.7 px, relative to a frontal one.
    """

    by_blur_px: tuple[float, ...]
    by_slant: tuple[float, ...]

    def at(self, slant_deg: Array, blur_px: float) -> Array:
        """(...) pixels. The frontal size is linear in the blur, constant below the least and proportional beyond the
        largest one; the minor axis is linear in the slant, and constant beyond the last one."""
        frontal = float(np.interp(blur_px, BLUR_PX, self.by_blur_px)) * max(1.0, blur_px / BLUR_PX[-1])
        minor = np.asarray(self.by_slant) * np.cos(np.radians(SLANT_DEG))
        return (
            frontal * np.interp(slant_deg, SLANT_DEG, minor) / np.maximum(np.cos(np.radians(slant_deg)), 1e-9)
        )


HALF, NEARLY_ALL = 0.5, 0.99  # the measured shares
SIZES: dict[Ground, dict[float, SmallestSizes]] = {
    "cluttered": {
        HALF: SmallestSizes((7.29, 8.28, 11.0, 16.8, 22.5), (1.0, 1.084, 1.217, 1.376, 1.647, 1.929, 2.404)),
        NEARLY_ALL: SmallestSizes((10.1, 11.1, 16.4, 26.8, 37.6), (1.0, 1.1, 1.22, 1.41, 1.63, 1.89, 3.92)),
    },
    "even": {
        HALF: SmallestSizes((7.09, 7.43, 9.77, 13.5, 17.3), (1.0, 1.089, 1.207, 1.329, 1.604, 1.954, 2.422)),
        NEARLY_ALL: SmallestSizes((9.15, 9.6, 11.1, 14.9, 19.0), (1.0, 1.05, 1.1, 1.48, 1.63, 2.08, 3.23)),
    },
}
# A roundel that moves by more than this share of its diameter during the exposure counts as moving. Of moving ones,
# nine in ten are found in a first frame if they are as large as this and move by no more than this many diameters.
MOVING_SHARE, MOVING_PX, LONGEST_SHARE = 0.1, 20.0, 0.75
# Share of the diameter that the image's border may cut off; 14 px and more were found in all images.
CUT_SHARE = 0.1
MIN_DIAMETER_PX, MAX_DIAMETER_PX = 8.0, 400.0  # the detector's default settings
MIN_CONTRAST = 25.0  # grey levels, the detector's default setting


def smallest_major_px(slant_rad: Array | float, imaging: Imaging, share: float = NEARLY_ALL) -> Array:
    """The major axis of a roundel's outer ellipse at which the detector finds a share of the roundels, pixels.

    The share found is taken as a normal distribution of the size's logarithm, through the two measured shares.

    Args:
        slant_rad: (...) angle between the printed side's normal and the line of sight, radians, as it appears in the
            image: the cosine is the ratio of the axes.
        imaging: blur, and what surrounds the cards.
        share: 0.5 to 0.99.

    Returns:
        (...) pixels; infinite beyond the largest slant.
    """
    slant = np.degrees(np.asarray(slant_rad, float))
    half, nearly_all = (SIZES[imaging.ground][s].at(slant, imaging.blur_px) for s in (HALF, NEARLY_ALL))
    quantile = NormalDist().inv_cdf
    weight = quantile(share) / quantile(NEARLY_ALL)
    return np.where(slant <= MAX_SLANT_DEG, half ** (1 - weight) * nearly_all**weight, np.inf)


def threshold_D(slant_rad: Array | float, imaging: Imaging, share: float = NEARLY_ALL) -> Array:
    """D of the paper's model, (...) pixels: the minor axis at which a share of the roundels is found."""
    return smallest_major_px(slant_rad, imaging, share) * np.cos(slant_rad)
