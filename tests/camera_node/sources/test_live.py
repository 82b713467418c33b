# SPDX-License-Identifier: BSD-3-Clause
"""A source that reads a camera in a thread: opens it again, delivers the newest frame, and checks settings."""

import logging
from collections.abc import Mapping
from pathlib import Path

import pytest

from camera_node.foundation.errors import CameraError, ConfigError
from camera_node.protocol.messages import ControlValue
from camera_node.sources.frame import SourceSettings, parse_controls
from camera_node.sources.live import LiveSource
from tests.camera_node.sources.video_camera import VideoCamera, write_video
from tests.waiting import wait_for


@pytest.fixture
def video(tmp_path: Path) -> Path:
    return write_video(tmp_path / "camera.avi")


def test_a_camera_that_stops_is_opened_again_and_logged_once(video: Path, caplog):
    """One opening in three fails, as for a camera that is plugged in again; the frames arrive nevertheless."""
    caplog.set_level(logging.WARNING, "camera_node.device")
    openings = iter(range(1000))
    opened: list[VideoCamera] = []

    def open_camera(settings: SourceSettings, controls: Mapping[str, ControlValue]) -> VideoCamera:
        if next(openings) % 3 == 1:
            raise CameraError("not yet")
        opened.append(VideoCamera(video))
        return opened[-1]

    source = LiveSource(open_camera, reopen_s=0.01)
    frames = []
    for frame in source:
        frames.append(frame)
        if len(caplog.records) >= 4:
            source.close()
    assert {frame.image.shape for frame in frames} == {(48, 64)}
    assert [frame.t_ns for frame in frames] == sorted(frame.t_ns for frame in frames)
    lines = [record.getMessage() for record in caplog.records]
    assert all("delivers no frames (the video ended)" in line for line in lines[::2])
    assert all("again" in line for line in lines[1::2])
    assert all(camera.is_closed for camera in opened)
    assert source.incomplete == len(opened)


def test_the_newest_frame_is_delivered_and_others_are_counted(video: Path):
    """A reader that comes late gets the last frame; the two frames before it are counted as dropped."""
    source = LiveSource(lambda settings, controls: VideoCamera(video), reopen_s=100)
    wait_for(lambda: source.dropped == 2)
    frame = next(iter(source))
    assert abs(int(frame.image[0, 0]) - 150) <= 3  # JPEG
    source.close()
    assert list(source) == []


def test_settings_are_in_force_after_the_camera_returned(video: Path):
    """Changed settings and controls go to each later opening, with those of the start."""
    opened: list[tuple[float | None, Mapping[str, ControlValue]]] = []

    def open_camera(settings: SourceSettings, controls: Mapping[str, ControlValue]) -> VideoCamera:
        opened.append((settings.exposure_us, dict(controls)))
        return VideoCamera(video)

    source = LiveSource(open_camera, SourceSettings(controls=("mode=night",)), reopen_s=0.01)
    source.adjust(500.0, 2.0, {"focus": 30})
    wait_for(lambda: opened[-1] == (500.0, {"mode": "night", "focus": 30}))
    source.close()
    assert opened[0][1] == {"mode": "night"}
    assert (source.exposure_us, source.gain, source.controls) == (500.0, 2.0, {"mode": "night", "focus": 30})


@pytest.mark.parametrize(
    ("wanted", "message"),
    [
        ({"controls": {"focsu": 1}}, "no control 'focsu'; did you mean focus\\? known: focus, mode"),
        ({"controls": {"focus": 255}}, "focus=255: give a number from 0 to 250"),
        ({"controls": {"focus": 7}}, "give 0 plus a multiple of 5"),
        ({"controls": {"focus": 0.5}}, "give a whole number"),
        ({"controls": {"focus": "far"}}, "give a number"),
        ({"controls": {"mode": "dusk"}}, "give one of day, night"),
        ({"gain": 101.0}, "refuses gain"),
    ],
)
def test_a_value_that_the_camera_does_not_take_is_refused(video: Path, wanted: dict, message: str):
    """It is not stored either, so that the next opening does not fail."""
    stays = VideoCamera(video)
    stays.read = lambda: None  # type: ignore[method-assign]: a camera that waits for a trigger
    source = LiveSource(lambda settings, controls: stays)
    with pytest.raises(ConfigError, match=message):
        source.adjust(**wanted)
    source.close()
    assert (source.gain, source.controls, stays.adjusted) == (None, {}, [])


def test_controls_have_the_type_that_their_text_suggests():
    texts = ("focus=30", "Gamma=0.5", "LampOn=true", "TriggerMode=On", "name=a=b")
    expected = {"focus": 30, "Gamma": 0.5, "LampOn": True, "TriggerMode": "On", "name": "a=b"}
    assert parse_controls(texts) == expected
    for bad in ("focus", "=3", "focus="):
        with pytest.raises(ConfigError, match="give NAME=VALUE"):
            parse_controls([bad])
