# SPDX-License-Identifier: BSD-3-Clause
"""A source and a detector with the settings that can be changed while they run."""

import math
import threading
from collections.abc import Sequence
from typing import Any, Protocol, runtime_checkable

import msgspec
import numpy as np
from numpy.typing import NDArray

from camera_node.detector import Detector
from camera_node.errors import ConfigError
from camera_node.messages import Settings
from camera_node.pixels import Grey
from camera_node.roundels import Roundels
from camera_node.source import Source

OF_THE_SOURCE = ("exposure_us", "gain")
OF_THE_DETECTOR = ("min_contrast", "min_diameter_px", "max_diameter_px")


@runtime_checkable
class Adjustable(Protocol):
    """A source whose exposure (microseconds) and gain can be changed while it runs; None leaves one as it is."""

    def adjust(self, exposure_us: float | None, gain: float | None) -> None: ...


class Eye:
    """Detects in frames, but not where the mask is, and takes new settings between two frames."""

    def __init__(self, source: Source, detector: dict[str, Any], settings: Settings | None = None) -> None:
        """Raises ConfigError where `detector`, the keyword arguments of `Detector`, are out of range."""
        self._source, self._arguments = source, dict(detector)
        self._detector = Detector(**self._arguments)
        self.settings = settings or Settings(mask=())
        self._changing = threading.Lock()

    @property
    def threshold(self) -> float:
        """The detector's threshold, grey levels; NaN where it has none."""
        return getattr(self._detector, "threshold", math.nan)

    def detect(self, image: Grey) -> Roundels:
        """All roundels of a grey image (h, w) outside the mask."""
        roundels = self._detector.detect(image)
        return roundels.select(~masked(roundels.uv, self.settings.mask or ()))

    def adjust(self, wanted: Settings) -> None:
        """Take the settings that are given, or none of them.

        Raises:
            ConfigError: a setting that the source or the detector does not have, or a value it does not take.
        """
        given = {
            name: value for name in wanted.__struct_fields__ if (value := getattr(wanted, name)) is not None
        }
        exposure = {name: given.get(name) for name in OF_THE_SOURCE}
        with self._changing:
            if any(value is not None for value in exposure.values()) and not isinstance(
                self._source, Adjustable
            ):
                raise ConfigError("this source has no exposure or gain that could be set")
            self._rebuild({name: given[name] for name in OF_THE_DETECTOR if name in given})
            if isinstance(self._source, Adjustable):
                self._source.adjust(**exposure)
            self.settings = msgspec.structs.replace(self.settings, **given)

    def _rebuild(self, changes: dict[str, float]) -> None:
        if changes:
            arguments = {**self._arguments, **changes}
            self._detector, self._arguments = Detector(**arguments), arguments


def masked(uv: NDArray[np.float64], mask: Sequence[tuple[float, float, float, float]]) -> NDArray[np.bool_]:
    """Which centres (N, 2) lie in one of the rectangles [u0, v0, u1, v1]."""
    inside = np.zeros(len(uv), bool)
    for u0, v0, u1, v1 in mask:
        inside |= (uv >= (u0, v0)).all(axis=1) & (uv <= (u1, v1)).all(axis=1)
    return inside
