# SPDX-License-Identifier: BSD-3-Clause
"""Cameras of a Raspberry Pi, with a stand-in for picamera2. The driver has not been run on a Raspberry Pi."""

import gc
import sys
import time
from contextlib import closing

import numpy as np
import pytest

from camera_node.clocks.host_clock import unix_ahead_ns
from camera_node.commands.publish import open_source
from camera_node.foundation.errors import CameraAbsentError, ConfigError
from camera_node.sources import picamera
from camera_node.sources.drivers import identify
from camera_node.sources.frame import Frame, SourceSettings
from tests.camera_node.sources import picamera2_standin
from tests.camera_node.sources.picamera2_standin import METADATA, MODES, CompletedRequest, Picamera2
from tests.missing_package import advice_without
from tests.waiting import wait_for


@pytest.fixture(autouse=True)
def picamera2(monkeypatch: pytest.MonkeyPatch) -> type[Picamera2]:
    monkeypatch.setitem(sys.modules, "picamera2", picamera2_standin)
    monkeypatch.setattr(Picamera2, "opened", [])
    monkeypatch.setattr(picamera, "SILENCE_S", 0.1)
    picamera.local_picameras.cache_clear()
    return Picamera2


def request_of(frame: Frame) -> CompletedRequest:
    """The request in whose buffer the image of a frame is."""
    return next(r for r in Picamera2.opened[0].requests if np.shares_memory(r.buffer, frame.image))


SETTINGS = SourceSettings(width=1000, height=624, fps=30.0, exposure_us=9981, gain=2.0)


@pytest.mark.parametrize(("number", "is_rolling"), [(0, True), (1, False)])
def test_each_row_has_its_own_time(number: int, is_rolling: bool):
    """A row of the sensor is exposed until it is read: the first one of the mode at the stamp, the others later.

    The rows of the image are those of the crop, 206 to 2256 of 2464. `Detections` defines the time of an image row.
    """
    with closing(open_source(f"picamera:{number}", SETTINGS)) as source:
        frame = next(iter(source))
        request = request_of(frame)
    stamp_ns = request.get_metadata()["SensorTimestamp"]
    v = np.arange(624)
    sensor_row = METADATA["ScalerCrop"][1] + (v + 0.5) / 624 * METADATA["ScalerCrop"][3]
    row_ns = 1e9 / MODES[1]["fps"] / 2464 if is_rolling else 0.0
    ahead_ns = unix_ahead_ns(lambda: time.clock_gettime_ns(time.CLOCK_BOOTTIME))
    expected = stamp_ns + ahead_ns + sensor_row * row_ns - METADATA["ExposureTime"] * 500
    actual = frame.t_ns + ((v + 0.5) / 624 - 0.5) * frame.readout_us * 1000
    assert np.abs(actual - expected).max() < 20_000  # two readings of the clocks
    assert frame.exposure_us == METADATA["ExposureTime"]
    assert (frame.readout_us > 0) == is_rolling


def test_the_y_plane_is_not_copied_and_its_buffer_returns_with_the_last_array():
    """Rows are padded to 1024 bytes in memory."""
    with closing(open_source("picamera:0", SETTINGS)) as source:
        iterator = iter(source)
        frame = next(iterator)
        request = request_of(frame)
        part = frame.image[100:200:2]
        assert frame.image.shape == (624, 1000)
        assert frame.image.strides == (1024, 1)
        del frame
        next(iterator)  # the iterator holds a frame until the next one
        gc.collect()
        assert request.released == 0
        assert (part == 90).all()
        del part
        wait_for(lambda: request.released == 1, gc.collect)
        for _ in range(50):  # many more than there are buffers
            next(iterator)
    del iterator
    gc.collect()
    assert {request.released for request in Picamera2.opened[0].requests[:-2]} == {1}


def test_settings_are_libcameras_controls():
    """Sharpening and noise reduction are off, exposure and gain fixed; changes go to the running camera."""
    with closing(open_source("picamera:0", SETTINGS)) as source:
        camera = Picamera2.opened[0]
        expected = {"AeEnable": False, "ExposureTime": 9981, "AnalogueGain": 2.0, "FrameRate": 30.0}
        assert camera.set == {**expected, "Sharpness": 0.0, "NoiseReductionMode": 0}
        source.adjust(exposure_us=500.4, controls={"Sharpness": 1.5})
        assert (camera.set["ExposureTime"], camera.set["Sharpness"]) == (500, 1.5)
        with pytest.raises(ConfigError, match="give a number from 0 to 16"):
            source.adjust(controls={"Sharpness": 17.0})
        with pytest.raises(ConfigError, match="no control 'ColourGains'"):
            source.adjust(controls={"ColourGains": 1.0})
    assert camera.is_closed


def test_synchronized_cameras_need_a_rate_below_that_of_the_mode():
    def synchronized(fps: float) -> SourceSettings:
        return SourceSettings(fps=fps, controls=("SyncMode=Server",))

    with pytest.raises(ConfigError, match=r"below the 41\.85 Hz of its mode; give --fps 41 or less"):
        open_source("picamera:0", synchronized(41.8))
    with closing(open_source("picamera:0", synchronized(30.0))):
        assert Picamera2.opened[-1].set["SyncMode"] == 1


def test_a_camera_that_falls_silent_is_opened_again(caplog: pytest.LogCaptureFixture):
    with closing(open_source("picamera:1", SETTINGS)) as source:
        iterator = iter(source)
        next(iterator)
        Picamera2.opened[0].is_silent = True
        wait_for(lambda: len(Picamera2.opened) == 2)
        wait_for(lambda: "delivers frames again" in caplog.text, lambda: next(iterator))
    assert all(camera.is_closed for camera in Picamera2.opened)


def test_cameras_of_a_pi_are_listed_without_those_on_usb():
    cameras = picamera.list_picamera()
    assert [(camera.source, camera.name) for camera in cameras] == [
        ("picamera:0", "imx219"),
        ("picamera:1", "ov9281"),
    ]
    assert [mode.max_fps for mode in cameras[0].modes] == [206.65, 41.85]
    assert picamera.local_picameras() == ("picamera:0", "picamera:1")
    assert identify("picamera:0").key == identify("picamera:imx219").key != identify("picamera:1").key
    with pytest.raises(CameraAbsentError, match=r"no camera picamera:2; present: picamera:0 \(imx219\)"):
        open_source("picamera:2", SETTINGS)


def test_a_camera_in_use_is_reported_in_one_line():
    with closing(open_source("picamera:0", SETTINGS)):
        with pytest.raises(CameraAbsentError, match=r"resource busy.*used by no other program"):
            open_source("picamera:0", SETTINGS)
        assert "busy" in picamera.list_picamera()[0].note


def test_without_picamera2_one_line_says_what_to_install():
    advice = advice_without("picamera2", "camera_node", "--source", "picamera:0", "--name", "cam0")
    assert "pip install 'roundel[picamera]'" in advice
