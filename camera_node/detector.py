# SPDX-License-Identifier: BSD-3-Clause
"""The typed face of the native detector."""

from typing import Literal

import numpy as np
from numpy.typing import NDArray

from camera_node.roundels import Roundels


class Detector:
    """Finds roundels in grey images, and keeps what it learnt from frame to frame."""

    def __init__(
        self,
        *,
        detector: Literal["paper"] = "paper",
        inner_ratios: tuple[float, ...] = (0.6, 0.41),
        ratio_tolerance: float = 0.1,
        min_diameter_px: float = 8.0,
        max_diameter_px: float = 400.0,
    ) -> None:
        raise NotImplementedError

    def detect(self, image: NDArray[np.uint8]) -> Roundels:
        """All roundels of a grey image (h, w), uint8."""
        raise NotImplementedError
