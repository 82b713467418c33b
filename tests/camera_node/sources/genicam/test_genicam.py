# SPDX-License-Identifier: BSD-3-Clause
"""GenICam cameras: Aravis's fake GigE camera in a process of its own sends real GVSP packets over loopback."""

import gc
import logging
import os
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from itertools import islice
from pathlib import Path

import numpy as np
import pytest

from camera_node.clocks.host_clock import unix_ahead_ns
from camera_node.commands.publish import open_source
from camera_node.foundation.errors import CameraAbsentError, CameraError, ConfigError
from camera_node.sources.drivers import identify
from camera_node.sources.frame import Frame, Source, SourceSettings
from camera_node.sources.genicam.genicam_source import list_genicam
from tests.camera_node.sources.genicam.fake_gige import FakeCamera, monotonic_of, stamp_in
from tests.conftest import ROOT
from tests.waiting import DEADLINE_S, slowness, wait_for

Starter = Callable[..., FakeCamera]
EXPOSURE_US = 4000.0
SMALL = {"width": 320, "height": 240, "exposure_us": EXPOSURE_US}


@contextmanager
def opened(camera: FakeCamera, **settings) -> Iterator[Source]:
    with closing(open_source(f"genicam:{camera.serial}", SourceSettings(**{**SMALL, **settings}))) as source:
        yield source


def error_us(frame: Frame) -> float:
    """The frame's time minus the middle of the exposure that began at the camera's own stamp, microseconds."""
    middle_ns = monotonic_of(stamp_in(frame.image)) + unix_ahead_ns() + EXPOSURE_US * 500
    return (frame.t_ns - middle_ns) / 1000


@pytest.fixture(scope="module")
def running(fake_library: Path) -> Iterator[Source]:
    """A camera at 100 Hz that the tests of this module share, because each opening takes seconds."""
    camera = FakeCamera(fake_library, 1)
    try:
        with opened(camera, fps=100.0, controls=("BinningVertical=1", "PixelFormat=Mono8")) as source:
            yield source
    finally:
        camera.stop()


def test_stamps_are_those_of_the_camera(running: Source):
    """Its clock is 7000 s ahead and drifts by 40 ppm. Errors are below 0.2 ms and below the stated bound."""
    frames = list(islice(running, 130))
    errors = np.array([error_us(frame) for frame in frames])
    bounds = np.array([frame.error_us for frame in frames])
    reading = 20  # of both clocks in this test, us
    assert np.abs(errors).max() < 200
    assert (np.abs(errors) < bounds + reading).all()
    assert {frame.image.shape for frame in frames} == {(240, 320)}
    assert {frame.exposure_us for frame in frames} == {EXPOSURE_US}


def test_controls_are_features_by_name(running: Source):
    """Also those that stop the acquisition; an unknown one is refused with a similar name."""
    iterator = iter(running)
    running.adjust(exposure_us=2000.0)
    wait_for(lambda: next(iterator).exposure_us == 2000.0)
    running.adjust(exposure_us=EXPOSURE_US, controls={"Height": 120})
    wait_for(lambda: next(iterator).image.shape == (120, 320))
    running.adjust(controls={"Height": 240})
    with pytest.raises(ConfigError, match="did you mean TriggerMode"):
        running.adjust(controls={"TrigerMode": "On"})
    with pytest.raises(ConfigError, match="give one of Off, On"):
        running.adjust(controls={"TriggerMode": "Maybe"})
    assert running.controls["Height"] == 240


def test_a_trigger_starts_each_frame(running: Source):
    """By software; the next frame is later than its request."""
    iterator = iter(running)
    running.adjust(controls={"TriggerSource": "Software", "TriggerMode": "On"})
    dropped = []
    for _ in range(3):
        requested_ns = time.time_ns()
        running.adjust(controls={"TriggerSoftware": True})
        wait_for(lambda since=requested_ns: next(iterator).t_ns > since)
        dropped.append(running.dropped)
    running.adjust(controls={"TriggerMode": "Off"})
    assert dropped[0] == dropped[-1]


def test_lost_packets_are_counted_and_their_frames_discarded(fake_camera: Starter):
    """Each delivered frame is complete: flat but for the stamp."""
    with opened(fake_camera(3, lost=0.02), fps=100.0, controls=("GevSCPSPacketSize=1500",)) as source:
        iterator = iter(source)
        frames = [next(iterator)]
        wait_for(
            lambda: source.lost_packets > 0 and source.incomplete > 0, lambda: frames.append(next(iterator))
        )
    assert all((frame.image[1:] == 100).all() for frame in frames)


@pytest.mark.parametrize("n_losses", [1, pytest.param(4, marks=pytest.mark.slow)])
def test_a_camera_that_loses_power_is_opened_again_without_a_leak(
    fake_camera: Starter, caplog: pytest.LogCaptureFixture, n_losses: int
):
    """Neither files nor threads grow, and each loss and return is logged once. It delivers within 2 s of its return."""
    caplog.set_level(logging.WARNING, "camera_node.device")
    camera, counts, delays_s = fake_camera(4), [], []
    with opened(camera, fps=50.0) as source:
        iterator = iter(source)
        frame = next(iterator)
        for k in range(n_losses + 1):
            gc.collect()
            counts.append((len(os.listdir("/proc/self/fd")), threading.active_count()))
            if k < n_losses:
                camera.stop()
                wait_for(lambda k=k: caplog.text.count("delivers no frames") == k + 1)
                camera.start()
                returned_s = time.monotonic()
                frame = next(frame for frame in iterator if caplog.text.count("frames again") == k + 1)
                delays_s.append(time.monotonic() - returned_s)
    assert abs(error_us(frame)) < 200
    assert counts[0] == counts[-1]
    assert len(caplog.records) == 2 * n_losses
    assert np.median(delays_s) < 2 * slowness()


@pytest.mark.slow
@pytest.mark.parametrize("is_noticed", [True, False])
def test_a_camera_that_is_away_is_closed_within_2_s(
    fake_camera: Starter, caplog: pytest.LogCaptureFixture, is_noticed: bool
):
    """Each request waits for an answer for three seconds; the thread that reads releases the camera later."""
    caplog.set_level(logging.WARNING, "camera_node.device")
    camera = fake_camera(9)
    source = open_source(f"genicam:{camera.serial}", SourceSettings(**SMALL, fps=50.0))
    next(iter(source))
    camera.stop()
    if is_noticed:
        wait_for(lambda: "delivers no frames" in caplog.text)
    started_s = time.monotonic()
    source.close()
    took_s = time.monotonic() - started_s
    assert list(source) == []
    wait_for(lambda: not any(camera.serial in thread.name for thread in threading.enumerate()))
    assert took_s < 2.2


@pytest.mark.slow
def test_cameras_are_found_by_serial_number_and_address(fake_camera: Starter):
    """Each look at the network takes a second."""
    first = fake_camera(5)
    second = fake_camera(6)
    listed = {camera.source: camera for camera in list_genicam()}
    assert listed[f"genicam:{second.serial}"].serial == second.serial
    assert {mode.pixels for mode in listed[f"genicam:{first.serial}"].modes} >= {"Mono8", "BayerRG8"}
    exposure = next(
        c for c in listed[f"genicam:{first.serial}"].controls if c.name.startswith("ExposureTime")
    )
    assert (exposure.kind, exposure.low) == ("float", 10)
    assert identify(f"genicam:{second.serial}").key == identify(f"genicam:{second.address}").key
    with pytest.raises(CameraAbsentError, match=f"genicam:nope; present: .*genicam:{first.serial}"):
        open_source("genicam:nope", SourceSettings())
    with pytest.raises(CameraAbsentError, match="several"):
        open_source("genicam:", SourceSettings())


@pytest.mark.slow
def test_two_programs_do_not_control_one_camera(fake_camera: Starter):
    """The second gets one line; the first goes on."""
    camera = fake_camera(7)
    with opened(camera, fps=50.0) as source:
        with pytest.raises(CameraError, match="controlled by another program"):
            open_source(f"genicam:{camera.serial}", SourceSettings())
        assert next(iter(source)).image.shape == (240, 320)


def test_without_aravis_one_line_says_what_to_install():
    """The library is hidden from a process of its own."""
    code = (
        "import ctypes, ctypes.util, sys\n"
        "class OwnOnly(ctypes.CDLL):\n"
        "    def __init__(self, name, *a, **k):\n"
        "        if name is not None: raise OSError(name)\n"
        "        super().__init__(name, *a, **k)\n"
        "ctypes.CDLL, ctypes.util.find_library = OwnOnly, lambda name: None\n"
        "import camera_node.sources.genicam.aravis as aravis\n"
        "aravis.find_library = lambda name: None\n"
        "from camera_node.__main__ import main; main()\n"
    )
    command = [sys.executable, "-c", code, "--source", "genicam:1", "--name", "cam0"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=DEADLINE_S, check=False)
    assert (done.returncode, len(done.stderr.splitlines())) == (2, 1)
    assert "apt install libaravis-0.8-0" in done.stderr
