# SPDX-License-Identifier: BSD-3-Clause
"""The detector's public import: `from camera_node.detector import Detector`."""

from camera_node.detection.detector import Detector
from camera_node.detection.roundels import Roundel, Roundels

__all__ = ["Detector", "Roundel", "Roundels"]
