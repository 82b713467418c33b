# SPDX-License-Identifier: BSD-3-Clause
"""A source and a detector with the settings that can be changed while they run."""

import threading
from typing import Any, Protocol, runtime_checkable

import msgspec

from camera_node.arrays import Grey
from camera_node.detection.detector import Detector
from camera_node.detection.roundels import Roundels
from camera_node.errors import ConfigError
from camera_node.protocol.messages import Settings
from camera_node.sources.frame import Source

OF_THE_SOURCE = ("exposure_us", "gain")
OF_THE_DETECTOR = tuple(set(Settings.__struct_fields__) - {"version", *OF_THE_SOURCE})


@runtime_checkable
class Adjustable(Protocol):
    """A source whose exposure (microseconds) and gain can be changed while it runs; None leaves one as it is.

    `settings` has the fields `exposure_us` and `gain`: what is in force, None where the camera chooses itself.
    """

    settings: Any

    def adjust(self, exposure_us: float | None, gain: float | None) -> None: ...


class Eye:
    """Detects in frames, and takes new settings between two frames."""

    def __init__(self, source: Source, detector: dict[str, Any]) -> None:
        """Raises ConfigError where `detector`, the keyword arguments of `Detector`, are out of range."""
        self._source = source
        self._detector = Detector(**detector)
        self._changing = threading.Lock()

    @property
    def threshold(self) -> float:
        """The detector's threshold, grey levels; NaN if it has none."""
        threshold = self._detector.threshold
        return float("nan") if threshold is None else threshold

    @property
    def settings(self) -> Settings:
        """All settings in force."""
        source = self._source.settings if isinstance(self._source, Adjustable) else None
        exposure = {name: getattr(source, name, None) for name in OF_THE_SOURCE}
        return Settings(**exposure, **self._detector.settings)

    def detect(self, image: Grey) -> Roundels:
        """All roundels of a grey image (h, w) outside the mask."""
        return self._detector.detect(image)

    def adjust(self, wanted: Settings) -> None:
        """Take the settings that are given, or none of them.

        Raises:
            ConfigError: a setting that the source or the detector does not have, or a value it does not take.
        """
        given = {name: value for name, value in msgspec.structs.asdict(wanted).items() if value is not None}
        exposure = {name: given.get(name) for name in OF_THE_SOURCE}
        with self._changing:
            if any(value is not None for value in exposure.values()) and not isinstance(
                self._source, Adjustable
            ):
                raise ConfigError("this source has no exposure or gain that could be set")
            if changes := {name: given[name] for name in OF_THE_DETECTOR if name in given}:
                self._detector = self._detector.adjusted(**changes)
            if isinstance(self._source, Adjustable):
                self._source.adjust(**exposure)
