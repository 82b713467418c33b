# SPDX-License-Identifier: BSD-3-Clause
"""The sensor model of Faigl, Krajnik, Chudoba and Saska (ICRA 2013), Section IV, by its equations and names.

A camera of focal lengths f_x, f_y and an image of w x h pixels sees a pattern of outer diameter d_o at the distance x
along its optical axis, turned by phi about the vertical and by psi about the horizontal axis of the image. The model
has no distortion and no blur; `camera_node.sensor_model.visibility` has both. See docs/design/sensor_model.md.
"""

from dataclasses import dataclass

import numpy as np

from camera_node.foundation.arrays import Array
from camera_node.geometry.lens import Lens

PAPER_D = 11.0  # px; the smallest size of a pattern that the paper's detector finds


@dataclass(frozen=True, slots=True)
class Pattern:
    """A printed roundel: the outer diameter d_o, the inner diameter d_i and the card's diameter d, metres.

    Raises:
        ValueError: the diameters are not 0 < d_i < d_o <= d.
    """

    d_o: float
    d_i: float
    d: float

    def __post_init__(self) -> None:
        if not 0 < self.d_i < self.d_o <= self.d < np.inf:
            raise ValueError(f"d_i {self.d_i}, d_o {self.d_o}, d {self.d}: give 0 < d_i < d_o <= d, metres")

    @classmethod
    def of(cls, diameter_m: float, inner_ratio: float = 0.6, surround_ratio: float = 9 / 7) -> "Pattern":
        """The pattern of outer diameter `diameter_m`, with the ratios d_i / d_o and d / d_o of the paper."""
        return cls(diameter_m, inner_ratio * diameter_m, surround_ratio * diameter_m)


@dataclass(frozen=True, slots=True)
class OperationalSpace:
    """The pyramid in which a camera sees patterns.

    Attributes:
        v_min, v_max: nearest and farthest distance along the optical axis, metres.
        v_y, v_z: width and height of its base, which is at v_max, metres; 0 where no pattern fits into the image.
    """

    v_min: float
    v_max: float
    v_y: float
    v_z: float


def image_size(lens: Lens, d_o: float, x: float, phi: float = 0.0, psi: float = 0.0) -> tuple[float, float]:
    """Width w_i and height h_i of the pattern's image, pixels: f_x d_o cos(phi) / x and f_y d_o cos(psi) / x.

    Args:
        lens: the camera.
        d_o: outer diameter of the pattern, metres.
        x: distance along the optical axis, metres.
        phi, psi: rotations of the pattern about the image's vertical and horizontal axis, radians.
    """
    return lens.fx * d_o * float(np.cos(phi)) / x, lens.fy * d_o * float(np.cos(psi)) / x


def nearest_distance(lens: Lens, d_o: float) -> float:
    """v_min, metres: d_o max(f_x / w, f_y / h), where the pattern fills the image."""
    return d_o * max(lens.fx / lens.width, lens.fy / lens.height)


def farthest_distance(lens: Lens, d_o: float, D: float, phi: float = 0.0, psi: float = 0.0) -> float:
    """v_max, metres: d_o / D min(f_x cos(phi), f_y cos(psi)), where the pattern's image is D pixels small."""
    return d_o / D * float(min(lens.fx * np.cos(phi), lens.fy * np.cos(psi)))


def base_at(lens: Lens, d_o: float, x: float) -> Array:
    """(2,) width and height, metres, of the part of the plane at distance x in which the pattern can be.

    x w / f_x - 2 d_o and x h / f_y - 2 d_o. The paper prints f_x / w and f_y / h, with which a longer focal length
    would widen the view. Of 2 d_o, one d_o keeps the disc inside the image, the other is a margin.
    """
    image_m = x * np.array([lens.width / lens.fx, lens.height / lens.fy])
    return np.maximum(image_m - 2 * d_o, 0.0)


def operational_space(
    lens: Lens, d_o: float, D: float = PAPER_D, phi: float = 0.0, psi: float = 0.0
) -> OperationalSpace:
    """The operational space of patterns of diameter d_o, metres, that the detector finds from D pixels on."""
    v_max = farthest_distance(lens, d_o, D, phi, psi)
    v_y, v_z = base_at(lens, d_o, v_max)
    return OperationalSpace(nearest_distance(lens, d_o), v_max, float(v_y), float(v_z))
