# SPDX-License-Identifier: BSD-3-Clause
"""The exceptions of calibration."""

from camera_node.foundation.errors import RoundelError


class CalibrationError(RoundelError):
    """No reliable calibration is possible from these cameras, this wand or this recording."""


class CameraFault(CalibrationError):
    """Some cameras contradict the others.

    Attributes:
        reasons: what is wrong, by camera name; reads on after the name.
        certain: whether the reason was observed; otherwise a later diagnosis may replace it.
    """

    def __init__(self, reasons: dict[str, str], certain: bool = True) -> None:
        super().__init__("; ".join(f"camera '{name}': {reason}" for name, reason in reasons.items()))
        self.reasons = reasons
        self.certain = certain
