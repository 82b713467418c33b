# SPDX-License-Identifier: BSD-3-Clause
"""A camera node over Zenoh: its publications, its replies, and its end."""

import contextlib
import logging
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import cv2
import msgspec
import numpy as np
import pytest
import zenoh

from camera_node.commands.publish import open_source
from camera_node.detection.detector import Detector
from camera_node.node.node import Node, NodeOptions
from camera_node.protocol.messages import CameraStatus, ClockReply, Detections, Keys, Settings, decode, encode
from camera_node.sources.frame import SourceSettings
from tests.camera_node.node.picture import CENTRE, render
from tests.waiting import DEADLINE_S, in_thread

MS = 1_000_000
START = 1_700_000_000_000_000_000
KEYS = Keys("arena")


@pytest.fixture(scope="module")
def frames(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Forty frames, 50 ms apart."""
    folder, image = tmp_path_factory.mktemp("frames"), render()
    for k in range(40):
        cv2.imwrite(str(folder / f"{START + 50 * MS * k}.png"), image)
    return folder


@pytest.fixture
def slow(tmp_path: Path) -> Path:
    """A minute of frames, one every 100 ms, of one file."""
    folder = tmp_path / "slow"
    folder.mkdir()
    first = folder / "0.png"
    cv2.imwrite(str(first), render())
    for k in range(1, 600):
        (folder / f"{100 * MS * k}.png").symlink_to(first)
    return folder


@pytest.fixture
def running(network):
    """`running(folder)`: a node in a thread, until the test ends."""
    nodes = contextlib.ExitStack()

    def start(folder: Path, **settings) -> Node:
        source = open_source(str(folder), SourceSettings(**settings))
        keep_stamps = source.is_recording and settings.get("stamps", "recorded") == "recorded"
        node = Node("cam0", source, Detector(), network.client(), NodeOptions(keep_stamps=keep_stamps))
        nodes.enter_context(in_thread(node.run, node.close))
        return node

    with nodes:
        yield start


def subscribe(session: zenoh.Session, key: str, kind: type, inbox):
    box = inbox()
    session.declare_subscriber(key, lambda sample: box.put(decode(sample.payload.to_bytes(), kind)))
    return box


def test_every_frame_arrives_with_its_recorded_time(network, inbox, running, frames):
    """In order, with the roundel where it was drawn, to 0.1 px; rounding to sub-pixels in the drawing costs 0.03."""
    got = subscribe(network.router(), KEYS.detections(), Detections, inbox)
    running(frames)
    assert got.until(lambda messages: len(messages) == 40), [message.seq for message in got.items]
    assert [message.t_ns for message in got.items] == [START + 50 * MS * k for k in range(40)]
    assert [message.seq for message in got.items] == list(range(40))
    assert {(message.camera, message.width, message.height) for message in got.items} == {("cam0", 320, 240)}
    assert len({message.publisher for message in got.items}) == 1
    for message in got.items:
        np.testing.assert_allclose(message.unpack().uv, [CENTRE], atol=0.1)
        assert message.detect_us > 0


def test_a_burst_of_recorded_frames_arrives_complete(network, inbox, running, tmp_path):
    """As after a pause of the machine: a link that is busy delays them."""
    cv2.imwrite(str(tmp_path / f"{START}.png"), render())
    times = [START + k for k in range(1000)]  # ns
    for t_ns in times[1:]:
        (tmp_path / f"{t_ns}.png").symlink_to(tmp_path / f"{START}.png")
    got = subscribe(network.router(), KEYS.detections(), Detections, inbox)
    running(tmp_path)
    assert got.until(lambda messages: len(messages) == len(times)), len(got.items)
    assert [message.t_ns for message in got.items] == times


def test_two_nodes_with_one_name_can_be_told_apart(network, inbox, running, frames):
    got = subscribe(network.router(), KEYS.detections(), Detections, inbox)
    running(frames)
    running(frames)
    assert got.until(lambda messages: len({message.publisher for message in messages} - {0}) == 2)


def test_the_status_is_published_once_a_second_and_the_token_ends_with_the_node(
    network, inbox, running, slow, caplog: pytest.LogCaptureFixture
):
    """10 frames are sent per second; on a loaded machine a few of them may be sent in the next second. The log names
    the rate of the first full second."""
    caplog.set_level(logging.INFO, "camera_node")
    router, alive = network.router(), inbox()
    statuses = subscribe(router, KEYS.camera_status(), CameraStatus, inbox)
    subscribe(router, KEYS.detections(), Detections, inbox)
    router.liveliness().declare_subscriber(KEYS.camera_alive(), alive.put, history=True)
    begun = time.monotonic()
    node = running(slow)
    assert statuses.until(lambda items: len(items) == 3)  # the log of the second precedes it
    assert time.monotonic() - begun >= 3
    status = statuses.items[0]
    assert (status.camera, status.width, status.height, status.roundels) == ("cam0", 320, 240, 1.0)
    assert (status.dropped, status.refused, status.advice) == (0, 0, "")
    assert 4 <= status.fps <= 16
    assert status.clock_offset_ms is None
    node.close()
    (announced,) = [line for line in caplog.messages if "publishes" in line]
    assert f"publishes {statuses.items[1].fps:.1f} frames/s of 320 x 240 pixels" in announced
    assert alive.until(lambda samples: len(samples) == 2)
    assert [sample.kind for sample in alive.items] == [zenoh.SampleKind.PUT, zenoh.SampleKind.DELETE]


def test_stamps_are_in_the_servers_time(network, inbox, running, slow):
    """The server's clock is an hour ahead: stamps follow it within the error bound in the status."""
    hour, router = 3600 * 10**9, network.router()
    router.declare_queryable(
        KEYS.clock, lambda query: query.reply(KEYS.clock, encode(ClockReply(time.time_ns() + hour)))
    )
    got = subscribe(router, KEYS.detections(), Detections, inbox)
    statuses = subscribe(router, KEYS.camera_status(), CameraStatus, inbox)
    running(slow, stamps="now")
    assert statuses.until(lambda items: items and items[-1].clock_offset_ms is not None)
    status = statuses.items[-1]
    assert abs(status.clock_offset_ms - 3_600_000) <= status.clock_error_ms
    assert got.until(lambda items: items and items[-1].t_ns > time.time_ns() + hour // 2)
    assert 0 < got.items[-1].clock_error_us < 5e5  # a round trip times out after half a second


def ask(session: zenoh.Session, key: str, payload: bytes | None = None) -> tuple[bool, bytes]:
    """The first reply: whether it is a success, and its payload."""
    for reply in session.get(key, payload=payload, timeout=DEADLINE_S):
        answer = reply.ok or reply.err
        assert answer
        return bool(reply.ok), answer.payload.to_bytes()
    raise AssertionError(f"no reply from {key}")


def test_a_snapshot_is_a_picture(network, inbox, running, slow):
    """At full quality JPEG changes a few grey levels; an invalid quality is refused."""
    router = network.router()
    got = subscribe(router, KEYS.detections(), Detections, inbox)
    running(slow)
    assert got.until(lambda items: len(items) > 1)
    ok, data = ask(router, KEYS.snapshot("cam0") + "?quality=100")
    assert ok
    image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_GRAYSCALE)
    assert image is not None
    assert np.abs(image.astype(int) - render()).max() <= 8
    assert len(ask(router, KEYS.snapshot("cam0") + "?quality=5")[1]) < len(data)
    assert not ask(router, KEYS.snapshot("cam0") + "?quality=best")[0]
    drawn = cv2.imdecode(
        np.frombuffer(ask(router, KEYS.snapshot("cam0") + "?draw")[1], np.uint8), cv2.IMREAD_COLOR
    )
    assert drawn is not None
    assert (
        drawn.max(axis=2).astype(int) - drawn.min(axis=2)
    ).max() > 100  # the ellipse and its number are in colour


def test_a_snapshot_shows_why_a_ring_is_refused(network, inbox, running, slow):
    """Another print is asked for: the ring is drawn amber instead of green. More than two a second are refused."""
    router = network.router()
    got = subscribe(router, KEYS.detections(), Detections, inbox)
    running(slow)
    assert got.until(lambda items: items and len(items[-1]) == 1)
    assert ask(router, KEYS.settings("cam0"), encode(Settings(inner_ratios=(0.3,))))[0]
    assert got.until(lambda items: len(items[-1]) == 0)
    ok, data = ask(router, KEYS.snapshot("cam0") + "?why")
    assert ok
    drawn = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
    assert drawn is not None
    assert (drawn[..., 2].astype(int) - drawn[..., 0]).max() > 100
    assert not all(ask(router, KEYS.snapshot("cam0") + "?why")[0] for _ in range(20))


def test_settings_are_reported_and_changed(network, inbox, running, slow):
    """A mask hides the roundel; replies have the encoding of the request; invalid requests are refused and counted."""
    router, key = network.router(), KEYS.settings("cam0")
    got = subscribe(router, KEYS.detections(), Detections, inbox)
    statuses = subscribe(router, KEYS.camera_status(), CameraStatus, inbox)
    running(slow)
    assert got.until(lambda items: items and len(items[-1]) == 1)
    first = decode(ask(router, key)[1], Settings)
    assert first == Settings(**Detector().settings)
    ok, reply = ask(router, key, b'{"mask": [[[100, 100], [200, 100], [200, 200], [100, 200]]]}')
    assert ok
    assert msgspec.json.decode(reply, type=Settings).mask == (
        ((100, 100), (200, 100), (200, 200), (100, 200)),
    )
    assert got.until(lambda items: len(items[-1]) == 0)
    assert ask(router, key, encode(Settings(mask=(), min_contrast=20)))[0]
    assert got.until(lambda items: len(items[-1]) == 1)
    assert not got.items[-1].readout_us
    assert ask(router, key, b'{"readout_us": 28000}')[0]
    assert got.until(lambda items: items[-1].readout_us == 28000)
    assert decode(ask(router, key)[1], Settings).readout_us == 28000
    bad = [
        b"\xff",
        b'{"colour": 1}',
        b'{"gain": 3}',
        b'{"exposure_us": -1}',
        b'{"readout_us": 2e6}',
        b'{"min_contrast": 0}',
        b"{" * 5000,
        b'{"mask": [[[0, 0], [1, 1]]]}',
        b'{"mask": [[[0, 0], [1e999, 1], [1, 1]]]}',
        b'{"ratio_tolerance": 0}',
    ]
    for payload in bad:
        ok, reply = ask(router, key, payload)
        assert not ok
        assert reply
    assert statuses.until(lambda items: items and items[-1].refused == len(bad))


def test_a_program_runs_on_while_the_server_is_away(network, inbox, eventually, slow, tmp_path):
    """It logs the absence once, delivers after the router opens, and ends with code 0 on a signal."""
    stops = {"cam0": signal.SIGTERM, "cam1": signal.SIGINT}
    with contextlib.ExitStack() as closing:
        nodes = {name: closing.enter_context(node_program(name, slow, network, tmp_path)) for name in stops}
        assert eventually(lambda: all("the server is away" in log.read_text() for _, log in nodes.values()))
        router = network.router_again()
        got = {name: subscribe(router, KEYS.detections(name), Detections, inbox) for name in stops}
        token = router.liveliness().declare_token(KEYS.fusion_alive)
        assert eventually(lambda: all("the server is back" in log.read_text() for _, log in nodes.values()))
        for name, stop in stops.items():
            node, log = nodes[name]
            assert got[name].until(len)
            node.send_signal(stop)
            assert node.wait(10) == 0
            assert log.read_text().count("the server is away") == 1
            assert "Traceback" not in log.read_text()
        token.undeclare()


@contextlib.contextmanager
def node_program(name: str, source: Path, network, folder: Path) -> Iterator[tuple[subprocess.Popen, Path]]:
    """A camera node in a process of its own, and the file with its log."""
    path = folder / name
    command = [sys.executable, "-m", "camera_node", "--source", str(source), "--name", name]
    with (
        path.open("w") as log,
        subprocess.Popen([*command, "--connect", network.endpoint], stderr=log) as node,
    ):
        try:
            yield node, path
        finally:
            node.kill()
