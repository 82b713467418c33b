# SPDX-License-Identifier: BSD-3-Clause
"""Reads `wand.yaml`."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from calib.errors import CalibrationError
from camera_node.foundation.config import load_yaml
from camera_node.geometry.body import Body, PrintedWand
from camera_node.protocol.messages import Detections


class WandBody(PrintedWand, frozen=True, kw_only=True, forbid_unknown_fields=True, omit_defaults=True):
    """A wand of roundels; or, with a diameter of 0, of lights and other points without a size."""

    diameter_m: float = 0.0

    def __post_init__(self) -> None:
        if self.diameter_m:
            super().__post_init__()
        else:
            self.check_layout()


def load_wand(path: Path) -> WandBody:
    """Read a wand: markers, and diameter_m unless they are lights or points.

    Raises:
        ConfigError: the file is missing, broken, or has an unknown field.
    """
    return load_yaml(path, WandBody)


def check_diameter(wand: Body, messages: Sequence[Detections]) -> None:
    """Raise CalibrationError if the detections have sizes, and the wand has no diameter to compare them with."""
    if wand.diameter_m:
        return
    sizes = b"".join(message.axes_px for message in messages)
    if np.isfinite(np.frombuffer(sizes, "<f4")).any():
        raise CalibrationError(
            "the recording has roundels with sizes, but the wand file has no diameter_m; add the diameter of the black "
            "disc in metres"
        )
