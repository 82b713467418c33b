# SPDX-License-Identifier: BSD-3-Clause
"""Settings that change while a camera runs."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from camera_node.detection.detector import Detector
from camera_node.errors import ConfigError
from camera_node.node.settings import apply_settings, read_settings
from camera_node.protocol.messages import Settings
from camera_node.sources.frame import SourceSettings
from camera_node.sources.replay import PacedSource
from camera_node.sources.v4l2 import V4l2Source


def test_exposure_and_detector_settings_are_applied_together(tmp_path: Path):
    """The camera is a video file that OpenCV opens like a camera."""
    path = tmp_path / "camera.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 30, (64, 48))
    writer.write(np.zeros((48, 64, 3), np.uint8))
    writer.release()
    source = V4l2Source(path, SourceSettings(gain=2.0), lambda p, _: cv2.VideoCapture(str(p)), reopen_s=100)
    changed = apply_settings(Settings(exposure_us=500.0, min_contrast=40.0), source, Detector())
    source.close()
    settings = read_settings(source, changed)
    assert (settings.exposure_us, settings.gain, settings.min_contrast) == (500.0, 2.0, 40.0)
    assert settings.ratio_tolerance == Detector().settings["ratio_tolerance"]


@pytest.mark.parametrize("refused", [{"gain": 3.0}, {"ratio_tolerance": 9.0}])
def test_a_refused_setting_changes_no_other_setting(refused: dict):
    """A recording has no gain, and a detector no tolerance above 0.5."""
    source, detector = PacedSource([], SourceSettings()), Detector()
    before = read_settings(source, detector)
    with pytest.raises(ConfigError):
        apply_settings(Settings(min_contrast=40.0, **refused), source, detector)
    assert read_settings(source, detector) == before
