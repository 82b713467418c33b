# SPDX-License-Identifier: BSD-3-Clause
"""The fault family of calibration."""

from camera_node.errors import RoundelError


class CalibrationError(RoundelError):
    """Cameras, a wand or a recording from which no trustworthy calibration follows."""


class CameraFault(CalibrationError):
    """Some cameras contradict the others.

    Attributes:
        reasons: by the camera's name, what is wrong, to be read after its name.
        certain: whether this is seen to be the reason; else another one may be found.
    """

    def __init__(self, reasons: dict[str, str], certain: bool = True) -> None:
        super().__init__("; ".join(f"camera '{name}': {why}" for name, why in reasons.items()))
        self.reasons = reasons
        self.certain = certain
