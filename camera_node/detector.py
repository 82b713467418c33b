# SPDX-License-Identifier: BSD-3-Clause
"""The typed face of the native detector."""

from typing import Literal

import numpy as np
from numpy.typing import NDArray

from camera_node import _core
from camera_node.errors import ConfigError
from camera_node.roundels import Roundels


class Detector:
    """Finds roundels in grey images, and keeps what it learnt from frame to frame.

    Args:
        detector: which search; "paper" is that of Faigl et al., ICRA 2013, made local.
        inner_ratios: inner over outer diameters of the prints in use.
        ratio_tolerance: how far a measured ratio may be from one of them.
        min_diameter_px, max_diameter_px: of the outer ellipse's major axis.
        min_contrast: bright less dark, grey levels; less finds more in the dark, and costs time in noise.

    Raises:
        ConfigError: a setting is out of its range.
    """

    def __init__(
        self,
        *,
        detector: Literal["paper"] = "paper",
        inner_ratios: tuple[float, ...] = (0.6, 0.41),
        ratio_tolerance: float = 0.1,
        min_diameter_px: float = 8.0,
        max_diameter_px: float = 400.0,
        min_contrast: float = 25.0,
    ) -> None:
        if detector != "paper":
            raise ConfigError(f"there is no detector '{detector}'; choose paper")
        if not inner_ratios or not all(0.1 <= ratio <= 0.95 for ratio in inner_ratios):
            raise ConfigError(f"inner_ratios are {inner_ratios}; give one or more numbers in [0.1, 0.95]")
        if not 0 < ratio_tolerance <= 0.5:
            raise ConfigError(f"ratio_tolerance is {ratio_tolerance}; give a number in (0, 0.5]")
        if not 6 <= min_diameter_px < max_diameter_px <= 10000:
            raise ConfigError(
                f"diameters of {min_diameter_px} to {max_diameter_px} px; give two in rising order in [6, 10000]"
            )
        if not 5 <= min_contrast <= 250:
            raise ConfigError(f"min_contrast is {min_contrast}; give grey levels in [5, 250]")
        self._core = _core.Detector(
            list(inner_ratios), ratio_tolerance, min_diameter_px, max_diameter_px, min_contrast
        )

    @property
    def threshold(self) -> float:
        """The paper's theta, grey levels."""
        return self._core.theta

    def detect(self, image: NDArray[np.uint8]) -> Roundels:
        """All roundels of a grey image (h, w), uint8."""
        if image.dtype != np.uint8 or image.ndim != 2:
            raise ValueError(f"a grey image (h, w) of uint8 is needed, got {image.dtype} {image.shape}")
        if image.strides[1] != 1:
            image = np.ascontiguousarray(image)
        table = self._core.detect(image)
        cov = table[:, [2, 3, 3, 4]].reshape(-1, 2, 2)
        none = np.full(len(table), -1, np.int32)
        return Roundels(table[:, :2], cov, table[:, 5:7], table[:, 7], table[:, 8], table[:, 9], none, none)
