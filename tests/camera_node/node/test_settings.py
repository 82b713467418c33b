# SPDX-License-Identifier: BSD-3-Clause
"""Settings that change while a camera runs."""

from pathlib import Path

import pytest

from camera_node.detection.detector import Detector
from camera_node.foundation.errors import ConfigError
from camera_node.node.node import apply_settings, read_settings
from camera_node.protocol.messages import Settings
from camera_node.sources.frame import SourceSettings
from camera_node.sources.live import LiveSource
from camera_node.sources.recorded_frames import PacedSource
from tests.camera_node.sources.video_camera import VideoCamera, write_video


def test_exposure_and_detector_settings_are_applied_together(tmp_path: Path):
    """The camera is a stand-in that accepts exposure, gain and controls."""
    path = write_video(tmp_path / "camera.avi")
    source = LiveSource(lambda settings, controls: VideoCamera(path), SourceSettings(gain=2.0), reopen_s=100)
    wanted = Settings(exposure_us=500.0, min_contrast=40.0, controls={"focus": 30})
    changed = apply_settings(wanted, source, Detector())
    source.close()
    settings = read_settings(source, changed)
    assert (settings.exposure_us, settings.gain, settings.min_contrast) == (500.0, 2.0, 40.0)
    assert settings.controls == {"focus": 30}
    assert settings.ratio_tolerance == Detector().settings["ratio_tolerance"]


@pytest.mark.parametrize("refused", [{"gain": 3.0}, {"ratio_tolerance": 9.0}])
def test_a_refused_setting_changes_no_other_setting(refused: dict):
    """A recording has no gain, and a detector no tolerance above 0.5."""
    source, detector = PacedSource([], SourceSettings()), Detector()
    before = read_settings(source, detector)
    with pytest.raises(ConfigError):
        apply_settings(Settings(min_contrast=40.0, **refused), source, detector)
    assert read_settings(source, detector) == before
