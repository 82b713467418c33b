# SPDX-License-Identifier: BSD-3-Clause
"""Reads and changes the settings of a camera while it runs."""

from camera_node.detection.detector import Detector
from camera_node.protocol.messages import Settings
from camera_node.sources.frame import Source


def read_settings(source: Source, detector: Detector, readout_us: float | None = None) -> Settings:
    """The settings in use."""
    return Settings(
        exposure_us=source.exposure_us,
        gain=source.gain,
        controls=dict(source.controls) or None,
        readout_us=readout_us,
        **detector.settings,
    )


def apply_settings(wanted: Settings, source: Source, detector: Detector) -> Detector:
    """Apply the settings that are not None, all of them or none.

    Returns:
        The detector for the next frame, which continues the tracks of `detector`.

    Raises:
        ConfigError: the source or the detector does not have a setting or refuses its value.
    """
    changes = {name: getattr(wanted, name) for name in detector.settings}
    changes = {name: value for name, value in changes.items() if value is not None}
    adjusted = detector.adjusted(**changes) if changes else detector
    if (wanted.exposure_us, wanted.gain, wanted.controls) != (None, None, None):
        source.adjust(wanted.exposure_us, wanted.gain, wanted.controls)
    return adjusted
