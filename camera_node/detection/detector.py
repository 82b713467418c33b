# SPDX-License-Identifier: BSD-3-Clause
"""The typed face of the native detector."""

from collections.abc import Sequence
from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from camera_node import _core
from camera_node.arrays import Array, Grey
from camera_node.detection.roundels import Roundels
from camera_node.errors import ConfigError


class Detector:
    """Finds roundels in grey images, and keeps what it learnt from frame to frame.

    Args:
        detector: which search; "chords" looks along rows and columns at once, "paper" is that of Faigl et al.,
            ICRA 2013, made local: the reference, a tenth as fast.
        inner_ratios: inner over outer diameters of the prints in use.
        ratio_tolerance: how far a measured ratio may be from one of them.
        min_diameter_px, max_diameter_px: of the outer ellipse's major axis.
        min_contrast: bright less dark, grey levels; less finds more in the dark, and costs time in noise.
        search_share: of each frame that is searched for new roundels at most. What has not changed since it was
            searched is left out for up to 15 frames; those that were in the last frame are looked for where they are
            expected. Less bounds the cost where much changes, and finds what is new then within 1 / share frames (if
            it is larger than 64 px and two frames share it, perhaps later).
        mask: polygons (N, 2) of raw pixels; a roundel whose centre lies in one is left out.

    Attributes:
        settings: what is in force, by the names above.

    Raises:
        ConfigError: a setting is out of its range.
    """

    def __init__(
        self,
        *,
        detector: Literal["chords", "paper"] = "chords",
        inner_ratios: tuple[float, ...] = (0.6, 0.41),
        ratio_tolerance: float = 0.08,
        min_diameter_px: float = 8.0,
        max_diameter_px: float = 400.0,
        min_contrast: float = 25.0,
        search_share: float = 1.0,
        mask: Sequence[ArrayLike] = (),
    ) -> None:
        if detector not in ("chords", "paper"):
            raise ConfigError(f"there is no detector '{detector}'; choose chords or paper")
        if not inner_ratios or not all(0.1 <= ratio <= 0.95 for ratio in inner_ratios):
            raise ConfigError(f"inner_ratios are {inner_ratios}; give one or more numbers in [0.1, 0.95]")
        if not 0 < ratio_tolerance <= 0.5:
            raise ConfigError(f"ratio_tolerance is {ratio_tolerance}; give a number in (0, 0.5]")
        if not 6 <= min_diameter_px < max_diameter_px <= 10000:
            raise ConfigError(
                f"diameters of {min_diameter_px} to {max_diameter_px} px; give two in rising order in [6, 10000]"
            )
        self._mask = [_check_polygon(polygon) for polygon in mask]
        if not 5 <= min_contrast <= 250:
            raise ConfigError(f"min_contrast is {min_contrast}; give grey levels in [5, 250]")
        if not 0.01 <= search_share <= 1:
            raise ConfigError(f"search_share is {search_share}; give a number in [0.01, 1]")
        self._core = _core.Detector(
            list(inner_ratios),
            ratio_tolerance,
            min_diameter_px,
            max_diameter_px,
            min_contrast,
            search_share,
            detector == "paper",
        )
        self._name: Literal["chords", "paper"] = detector
        self._offsets, self._covariance = np.empty((0, 2)), np.empty((0, 7, 7))
        self.settings: dict[str, Any] = {
            "inner_ratios": tuple(inner_ratios),
            "ratio_tolerance": ratio_tolerance,
            "min_diameter_px": min_diameter_px,
            "max_diameter_px": max_diameter_px,
            "min_contrast": min_contrast,
            "search_share": search_share,
            "mask": tuple(tuple((float(u), float(v)) for u, v in polygon) for polygon in self._mask),
        }

    @property
    def threshold(self) -> float:
        """The paper's theta, grey levels."""
        return self._core.theta

    @property
    def postponed(self) -> int:
        """Places of the last frame that may hold a roundel and were left for the next frame, which begins there.

        Not 0 only where a picture has hundreds of ring-like places that are not tracked: a frame's work is bounded.
        """
        return self._core.postponed

    def adjusted(self, **changes: Any) -> "Detector":
        """One with other settings, by the names of the constructor, that carries on this one's tracks.

        Raises:
            ConfigError: a setting is out of its range.
        """
        other = Detector(**{"detector": self._name, **self.settings, **changes})
        other._core.take_over(self._core)
        return other

    def disc_offsets(self) -> tuple[Array, Array]:
        """Of the last frame's roundels, in their order: where the discs' own centres project, from `uv`.

        Measured by the inner ellipse's place in the outer one.

        Returns:
            (N, 2) offsets, pixels, and (N, 7, 7) the covariance of all that tells a pose: of `uv`, of the ellipse's
            shape xx, xy, yy (it is `uv` + A q, |q| = 1, A symmetric), and of the offset; pixels.
        """
        return self._offsets, self._covariance

    def detect(self, image: Grey) -> Roundels:
        """Detect all roundels of a grey image (h, w), uint8; its rows may be apart in memory.

        Raises:
            ValueError: the array is no such image; `camera_node.sources.grey.to_grey` converts other formats.
        """
        if image.dtype != np.uint8 or image.ndim != 2:
            raise ValueError(f"image is {image.dtype} {image.shape}; convert it to uint8 (h, w) with to_grey")
        table = self._core.detect(image if image.strides[1] == 1 else np.ascontiguousarray(image))
        table = table[[not self._is_masked(row[:2]) for row in table]] if self._mask else table
        self._offsets, self._covariance = table[:, 7:9], _symmetric(table[:, 10:])
        none = np.full(len(table), -1, np.int32)
        return Roundels(
            table[:, :2],
            self._covariance[:, :2, :2],
            table[:, 2:4],
            table[:, 4],
            table[:, 5],
            table[:, 6],
            none,
            table[:, 9].astype(np.int32),
        )

    def _is_masked(self, uv: Array) -> bool:
        at = (float(uv[0]), float(uv[1]))
        return any(cv2.pointPolygonTest(polygon, at, False) >= 0 for polygon in self._mask)


def _check_polygon(polygon: ArrayLike) -> NDArray[np.float32]:
    corners = np.asarray(polygon, np.float32)
    if corners.ndim != 2 or corners.shape[1] != 2 or len(corners) < 3 or not np.isfinite(corners).all():
        raise ConfigError("mask must be polygons of three or more [u, v], in pixels")
    return corners


def _symmetric(upper: Array) -> Array:
    """Matrices (N, 7, 7) from their upper triangles (N, 28)."""
    full = np.empty((len(upper), 7, 7))
    i, j = np.triu_indices(7)
    full[:, i, j] = full[:, j, i] = upper
    return full
