# SPDX-License-Identifier: BSD-3-Clause
"""Network streams: an MJPEG server on loopback, GStreamer's RTSP server where it is installed, and their times."""

import logging
import socket
import time
from itertools import islice

import numpy as np
import pytest

from camera_node.clocks.device_clock import LEAST_US, UNKNOWN_US, ArrivalClock
from camera_node.commands.publish import open_source
from camera_node.foundation.errors import CameraAbsentError, ConfigError
from camera_node.sources.frame import SourceSettings
from camera_node.sources.network_stream import open_stream
from fusion.model.frames import clock_sigma_s
from tests.camera_node.sources import rtsp_server
from tests.camera_node.sources.mjpeg_server import SHAPE, MjpegServer
from tests.camera_node.sources.rtsp_server import RtspServer, capture_time_ns
from tests.conftest import free_port
from tests.missing_package import advice_without
from tests.waiting import wait_for


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


@pytest.mark.slow
def test_a_stream_is_read_again_within_2_s_when_its_machine_answers_again(caplog: pytest.LogCaptureFixture):
    """A machine without power drops requests to connect; so does a socket whose queue of connections is full."""
    with MjpegServer(free_port()) as server, caplog.at_level(logging.DEBUG):
        source = open_stream(server.url)
        iterator = iter(source)
        next(iterator)
        server.stop()
        at = "127.0.0.1", server.port
        with socket.create_server(at, backlog=0), socket.create_connection(at):
            wait_for(lambda: caplog.text.count("no answer within") >= 2)
        returned_ns = time.time_ns()
        server.start()
        frame = next(frame for frame in iterator if frame.t_ns > returned_ns)
        source.close()
    assert frame.t_ns - returned_ns < 2e9


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


def test_an_rtsp_stream_has_the_senders_times_with_the_stated_error():
    """Images contain their capture times, and are sent 20 ms and an exponential 5 ms later. Squared errors over stated
    variances are 1 at most on average, relative to the constant delay, which is calibrated; and neither the errors nor
    what is stated of them are those of the arrivals."""
    with RtspServer(mean_delay_s=0.005) as server:
        source = open_stream(server.url)
        frames = list(islice(source, 100))
        source.close()
    assert {frame.image.shape for frame in frames} == {rtsp_server.SHAPE}
    captured_ns = np.array([capture_time_ns(frame.image) for frame in frames])
    assert (np.diff(captured_ns) > 0).all()
    late_s = np.array([frame.t_ns for frame in frames] - captured_ns)[30:] * 1e-9
    sigmas = np.array([clock_sigma_s(frame.error_us) for frame in frames])[30:]
    errors = late_s - late_s.mean()
    assert np.mean((errors / sigmas) ** 2) < 1.0
    assert max(errors.std(), sigmas.mean()) < 0.002


def test_an_rtsp_stream_is_read_again_within_2_s_of_its_servers_return():
    with RtspServer(mean_delay_s=0.001) as server:
        source = open_stream(server.url)
        iterator = iter(source)
        next(iterator)
        server.kill()
        server.start()
        returned_ns = time.time_ns()
        frame = next(frame for frame in iterator if capture_time_ns(frame.image) > returned_ns)
        source.close()
    assert frame.t_ns - returned_ns < 2e9


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
