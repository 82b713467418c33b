# SPDX-License-Identifier: BSD-3-Clause
"""Detects roundels in grey images: the Python interface of the native detector."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal, TypedDict, Unpack

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from camera_node import _core
from camera_node.detection.roundels import DetectedRoundels
from camera_node.foundation.arrays import Array, Grey
from camera_node.foundation.errors import ConfigError

MAX_RATIOS = 16


@dataclass(frozen=True)
class DetectorSettings:
    """Settings of a detector that can be changed while it runs.

    Attributes:
        inner_ratios: inner over outer diameters of the prints in use. Without any, the detector finds them: rings of
            0.26 to 0.74 and 14 px count as roundels, and those of one ratio that recur teach it as that of a print.
        ratio_tolerance: largest difference between a measured ratio and that of a print.
        min_diameter_px, max_diameter_px: limits on the major axis of the outer ellipse.
        min_contrast: least difference of the bright and the dark level, grey levels. A lower value finds more in poor
            light, and costs time in noisy images.
        search_share: largest share of a frame that is searched for new roundels. Parts that do not change are
            searched in every 16th frame only; tracked roundels are fitted at their predicted positions in any case. A
            lower value bounds the time spent when much of the image changes: a new roundel is then found within
            1 / share frames (possibly later if it is larger than 64 px and lies across two bands).
        mask: polygons (N, 2) in raw pixels; roundels with their centre inside are discarded.

    Raises:
        ConfigError: a setting is out of its range.
    """

    inner_ratios: Sequence[float] = ()
    ratio_tolerance: float = 0.08
    min_diameter_px: float = 8.0
    max_diameter_px: float = 400.0
    min_contrast: float = 25.0
    search_share: float = 1.0
    mask: Sequence[ArrayLike] = ()

    def __post_init__(self) -> None:
        smallest, largest = self.min_diameter_px, self.max_diameter_px
        if len(self.inner_ratios) > MAX_RATIOS or not all(0.1 <= r <= 0.95 for r in self.inner_ratios):
            raise ConfigError(
                f"inner_ratios are {self.inner_ratios}; give up to {MAX_RATIOS} numbers in [0.1, 0.95], or none"
            )
        if not 0 < self.ratio_tolerance <= 0.5:
            raise ConfigError(f"ratio_tolerance is {self.ratio_tolerance}; give a number in (0, 0.5]")
        if not 6 <= smallest < largest <= 10000:
            raise ConfigError(
                f"min_diameter_px is {smallest} and max_diameter_px {largest}; give two rising numbers in [6, 10000]"
            )
        if not 5 <= self.min_contrast <= 250:
            raise ConfigError(f"min_contrast is {self.min_contrast}; give grey levels in [5, 250]")
        if not 0.01 <= self.search_share <= 1:
            raise ConfigError(f"search_share is {self.search_share}; give a number in [0.01, 1]")

    @property
    def polygons(self) -> list[NDArray[np.float32]]:
        """The mask's polygons (N, 2). Raises ConfigError for one that is not a polygon."""
        return [_check_polygon(polygon) for polygon in self.mask]

    @property
    def limits(self) -> _core.RoundelLimits:
        """The limits of the native detector."""
        diameters = self.min_diameter_px, self.max_diameter_px
        return _core.RoundelLimits(
            list(self.inner_ratios), self.ratio_tolerance, *diameters, self.min_contrast
        )


class SettingKeywords(TypedDict, total=False):
    """The fields of `DetectorSettings` as keywords of `Detector`, for editors and type checkers."""

    inner_ratios: Sequence[float]
    ratio_tolerance: float
    min_diameter_px: float
    max_diameter_px: float
    min_contrast: float
    search_share: float
    mask: Sequence[ArrayLike]


class Detector:
    """Finds roundels in a sequence of grey images and tracks them from frame to frame.

    Args:
        detector: the search method. "chords" scans all rows, columns and diagonals. "paper" is the reference: the
            method of Faigl et al. (ICRA 2013) with local thresholds, at about a tenth of the speed.
        settings: see `DetectorSettings`.

    Attributes:
        settings: the settings in use, by name.

    Raises:
        ConfigError: a setting is out of its range.
    """

    def __init__(
        self, *, detector: Literal["chords", "paper"] = "chords", **settings: Unpack[SettingKeywords]
    ) -> None:
        if detector not in ("chords", "paper"):
            raise ConfigError(f"there is no detector '{detector}'; choose chords or paper")
        used = DetectorSettings(**settings)
        self._name: Literal["chords", "paper"] = detector
        self._mask = used.polygons
        self._core = _core.Detector(used.limits, used.search_share, detector == "paper")
        mask = tuple(tuple((float(u), float(v)) for u, v in polygon) for polygon in self._mask)
        self.settings: dict[str, Any] = {**vars(used), "inner_ratios": tuple(used.inner_ratios), "mask": mask}

    @property
    def threshold(self) -> float | None:
        """The threshold theta of the "paper" detector for the next frame, grey levels; None for "chords"."""
        return self._core.theta

    @property
    def tone_exponent(self) -> float | None:
        """The exponent that makes this camera's levels proportional to light; None before roundels determine it.

        A known print determines it, or roundels of one print and several sizes.
        """
        return self._core.tone_exponent

    @property
    def found_ratios(self) -> tuple[float, ...]:
        """The ratios of the prints that recur in this camera's frames; empty if `inner_ratios` is given."""
        return tuple(self._core.found_ratios)

    def adjusted(self, **changes: Any) -> "Detector":
        """A detector with other settings, by the names of the constructor.

        It continues this one's tracks and keeps what this one has learned about the camera.

        Raises:
            ConfigError: a setting is out of its range.
        """
        changed: dict[str, Any] = {**self.settings, **changes}
        other = Detector(detector=self._name, **changed)
        other._core.take_over(self._core)
        return other

    def detect(self, image: Grey) -> DetectedRoundels:
        """Detect all roundels in a grey image.

        Args:
            image: (h, w), uint8; its rows may be apart in memory.

        Raises:
            ValueError: the array is not a grey image; `camera_node.sources.grey.to_grey` converts other formats.
        """
        columns = self._core.detect(_as_rows(image))
        roundels = DetectedRoundels(cov=columns["pose_cov"][:, :2, :2], **columns)
        if not self._mask:
            return roundels
        return roundels.select(np.array([not self._is_masked(uv) for uv in roundels.uv], bool))

    def measure_rings(self, image: Grey) -> Array:
        """Ring-like shapes of an image that it does not accept as roundels, one row each; it learns nothing from them.

        Returns:
            (N, 9): u, v, major and minor axis, angle, ratio, contrast, misfit and reason, as in `refusals.RefusedRing`.

        Raises:
            ValueError: the array is not a grey image.
        """
        return self._core.explain(_as_rows(image))

    def _is_masked(self, uv: Array) -> bool:
        at = (float(uv[0]), float(uv[1]))
        return any(cv2.pointPolygonTest(polygon, at, False) >= 0 for polygon in self._mask)


def _as_rows(image: Grey) -> Grey:
    if not isinstance(image, np.ndarray):
        raise TypeError(
            f"image is {type(image).__name__}; give an array (cv2.imread returns None where there is no picture)"
        )
    if image.dtype != np.uint8 or image.ndim != 2:
        raise ValueError(f"image is {image.dtype} {image.shape}; convert it to uint8 (h, w) with to_grey")
    return image if image.strides[1] == 1 else np.ascontiguousarray(image)


def _check_polygon(polygon: ArrayLike) -> NDArray[np.float32]:
    corners = np.asarray(polygon, np.float32)
    if corners.ndim != 2 or corners.shape[1] != 2 or len(corners) < 3 or not np.isfinite(corners).all():
        raise ConfigError("mask has a polygon without three finite [u, v]; give three or more, in pixels")
    return corners
