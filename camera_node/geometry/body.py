# SPDX-License-Identifier: BSD-3-Clause
"""Rigid bodies with printed roundels: wands and robots."""

import msgspec
import numpy as np

from camera_node.arrays import Array

Vector = tuple[float, float, float]
MAX_EXTENT_M = 10.0  # of a marker's coordinates and of a roundel's diameter


class Body(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, omit_defaults=True):
    """Roundels of one size at known positions of a rigid body, with their printed side towards +z.

    Attributes:
        diameter_m: outer diameter d_o of the black disc, metres.
        markers: centres of the roundels, body frame, metres.
        inner_ratio: d_i / d_o, diameter of the white inner disc over d_o; 0.6 in the paper.
        surround_ratio: d / d_o, diameter of the white card over d_o; 9/7 in the paper.
    """

    diameter_m: float
    markers: tuple[Vector, ...] = ((0.0, 0.0, 0.0),)
    inner_ratio: float = 0.6
    surround_ratio: float = 9 / 7

    def __post_init__(self) -> None:
        if not 0.001 <= self.diameter_m <= MAX_EXTENT_M:
            raise ValueError(f"diameter_m is {self.diameter_m}; give the black disc's diameter d_o in metres")
        self.check_layout()

    def check_layout(self) -> None:
        """Raise ValueError unless the markers' positions and the ratios of diameters are plausible."""
        if not self.markers or not all(abs(x) <= MAX_EXTENT_M for marker in self.markers for x in marker):
            raise ValueError(
                f"markers must be one or more [x, y, z] in metres, each within {MAX_EXTENT_M:g} m"
            )
        if not (0.1 <= self.inner_ratio <= 0.95 and 1.0 <= self.surround_ratio <= 10):
            raise ValueError("inner_ratio must be in [0.1, 0.95] and surround_ratio in [1, 10]")

    @property
    def points(self) -> Array:
        """(M, 3) marker centres, body frame, metres."""
        return np.array(self.markers, float)
