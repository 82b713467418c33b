# SPDX-License-Identifier: BSD-3-Clause
"""Public import path of the detector: `from camera_node.detector import Detector`."""

from camera_node.detection.detector import Detector
from camera_node.detection.roundels import Roundel, Roundels

__all__ = ["Detector", "Roundel", "Roundels"]
