# SPDX-License-Identifier: BSD-3-Clause
"""Network streams: an MJPEG server on loopback, GStreamer's RTSP server where it is installed, and their times."""

import logging
import subprocess
import time
from collections.abc import Iterator
from itertools import islice
from pathlib import Path

import numpy as np
import pytest

from camera_node.clocks.arrival_clock import LEAST_US, UNKNOWN_US, ArrivalClock
from camera_node.commands.publish import open_source
from camera_node.errors import CameraAbsentError, ConfigError
from camera_node.sources.frame import SourceSettings
from camera_node.sources.stream import open_stream
from fusion.model.frames import clock_sigma_s
from tests.camera_node.sources.mjpeg_server import SHAPE, MjpegServer
from tests.conftest import free_port
from tests.missing_package import advice_without
from tests.waiting import wait_for, wait_for_port

RTSP_SERVER = """
import gi
gi.require_version("Gst", "1.0")
gi.require_version("GstRtspServer", "1.0")
from gi.repository import GLib, Gst, GstRtspServer
Gst.init(None)
server, factory = GstRtspServer.RTSPServer(), GstRtspServer.RTSPMediaFactory()
server.set_service("{port}")
factory.set_launch("( videotestsrc is-live=true pattern=ball "
                   "! video/x-raw,format=I420,width=320,height=240,framerate=30/1 ! jpegenc ! rtpjpegpay name=pay0 )")
factory.set_shared(True)
server.get_mount_points().add_factory("/live", factory)
server.attach(None)
GLib.MainLoop().run()
"""


def test_frames_of_an_mjpeg_stream_arrive_in_order_with_their_times():
    with MjpegServer(free_port()) as server:
        source = open_source(server.url, SourceSettings())
        before_ns = time.time_ns()
        frames = list(islice(source, 40))
        source.close()
    assert {frame.image.shape for frame in frames} == {SHAPE}
    levels = np.array([float(frame.image.mean()) for frame in frames])
    assert (np.diff(levels) > 0.5).all()  # each is newer than the one before; JPEG keeps a flat image's level
    stamps = [frame.t_ns for frame in frames]
    assert stamps == sorted(stamps)
    assert before_ns - 2 * 10**9 < stamps[0] < stamps[-1] < time.time_ns()
    assert frames[0].error_us == UNKNOWN_US
    assert LEAST_US <= frames[-1].error_us < UNKNOWN_US


def test_a_reader_that_is_slow_gets_the_newest_frame():
    with MjpegServer(free_port()) as server:
        source = open_stream(server.url)
        iterator = iter(source)
        first, before = next(iterator), source.dropped
        wait_for(lambda: source.dropped >= before + 10)
        second = next(iterator)
        source.close()
    assert float(second.image.mean()) - float(first.image.mean()) >= 9.5


def test_a_stream_is_read_again_when_its_server_returns(caplog: pytest.LogCaptureFixture):
    with MjpegServer(free_port()) as server, caplog.at_level(logging.INFO):
        source = open_stream(server.url, reopen_s=0.1)
        iterator = iter(source)
        next(iterator)
        server.stop()
        wait_for(lambda: "delivers no frames" in caplog.text)
        returned_ns = time.time_ns()
        server.start()
        frame = next(frame for frame in iterator if frame.t_ns > returned_ns)
        source.close()
    assert frame.t_ns - returned_ns < 2e9
    assert "delivers frames again" in caplog.text
    assert "***@127.0.0.1" in caplog.text
    assert not any(secret in caplog.text for secret in ("admin", "s3cret"))


@pytest.mark.parametrize("state", ["absent", "wrong password"])
def test_a_stream_that_does_not_open_is_reported_without_credentials(state: str):
    with MjpegServer(free_port()) as server:
        url = (
            server.url.replace("s3cret", "wr0ng")
            if state == "wrong password"
            else f"rtsp://admin:wr0ng@127.0.0.1:{free_port()}/live"
        )
        with pytest.raises(
            CameraAbsentError, match=r"\*\*\*@127.0.0.1.* does not open \(.*check address"
        ) as caught:
            open_stream(url)
    assert not any(secret in str(caught.value) for secret in ("admin", "wr0ng"))


def test_other_protocols_of_ffmpeg_are_refused():
    for url in ("file:///etc/passwd", "concat://a", "udp://127.0.0.1:1"):
        with pytest.raises(ConfigError, match="give rtsp://"):
            open_stream(url)


@pytest.fixture
def rtsp_server(tmp_path: Path) -> Iterator[str]:
    """The address of GStreamer's RTSP server; skips where Debian's packages of it are not installed."""
    port, script = free_port(), tmp_path / "server.py"
    script.write_text(RTSP_SERVER.format(port=port))
    python = "/usr/bin/python3"  # Debian's, which has GObject's bindings
    check = "import gi; gi.require_version('GstRtspServer', '1.0'); from gi.repository import GstRtspServer"
    if (
        not Path(python).exists()
        or subprocess.run([python, "-c", check], capture_output=True, check=False).returncode
    ):
        pytest.skip("gir1.2-gst-rtsp-server-1.0 is not installed")
    with subprocess.Popen([python, str(script)]) as process:
        try:
            wait_for_port(port)
            yield f"rtsp://127.0.0.1:{port}/live"
        finally:
            process.kill()


def test_an_rtsp_stream_has_the_senders_times(rtsp_server: str):
    source = open_stream(rtsp_server)
    frames = list(islice(source, 60))
    source.close()
    assert {frame.image.shape for frame in frames} == {(240, 320)}
    assert len(np.unique([frame.image.tobytes() for frame in frames])) > 50  # the ball moves
    intervals = np.diff([frame.t_ns for frame in frames[30:]]) * 1e-9
    periods = np.round(intervals * 30)
    assert (periods >= 1).all()
    assert np.median(np.abs(intervals - periods / 30)) < 1e-3  # those of the sender, not of the arrival


@pytest.mark.parametrize("has_times", [True, False])
@pytest.mark.parametrize("mean_delay_ms", [1.0, 10.0, 30.0])
def test_the_stated_error_holds(has_times: bool, mean_delay_ms: float):
    """Squared errors over stated variances: 1 at most on average; and the stated ones are not ten times the true ones.

    Delays are 40 ms plus an exponential part; the sender's clock is off by 1000 s and drifts by 50 ppm. Errors are
    relative to their mean, because a constant delay is calibrated.
    """
    rng, clock = np.random.default_rng(4), ArrivalClock()
    captured = 10**18 + np.arange(1500) * 33_333_333
    delays = 40e6 + rng.exponential(mean_delay_ms * 1e6, len(captured))
    arrived = np.maximum.accumulate(captured + delays).astype(np.int64)  # TCP keeps the order
    media = ((captured - captured[0]) * (1 + 50e-6) + 10**12).astype(np.int64)
    rows = [clock.stamp(int(a), int(m) if has_times else None) for a, m in zip(arrived, media, strict=True)]
    errors = np.array([t - c for (t, _), c in zip(rows, captured.tolist(), strict=True)])[300:] * 1e-9
    sigmas = np.array([clock_sigma_s(bound) for _, bound in rows])[300:]
    ratio = np.mean(((errors - errors.mean()) / sigmas) ** 2)
    assert ratio < 1.0
    assert sigmas.mean() < max(2e-6 * LEAST_US, 10 * errors.std())
    if has_times:
        assert errors.std() < 1e-3


def test_a_sender_that_restarts_its_clock_is_followed():
    clock = ArrivalClock()
    for k in range(100):
        clock.stamp(10**18 + k * 10**7, k * 10**7)
    t_ns, error_us = clock.stamp(10**18 + 100 * 10**7, 5 * 10**9)
    assert (t_ns, error_us) == (10**18 + 100 * 10**7, UNKNOWN_US)


def test_without_pyav_one_line_says_what_to_install():
    advice = advice_without(
        "av", "camera_node", "--source", "rtsp://admin:s3cret@127.0.0.1:9/live", "--name", "cam0"
    )
    assert "pip install 'roundel[streams]'" in advice
    assert "s3cret" not in advice
