# SPDX-License-Identifier: BSD-3-Clause
"""The fault family of calibration."""

from camera_node.errors import RoundelError


class CalibrationError(RoundelError):
    """Cameras, a wand or a recording from which no trustworthy calibration follows."""
