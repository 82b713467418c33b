# SPDX-License-Identifier: BSD-3-Clause
"""Small pictures of a camera: sent only while someone watches, bounded in size and cost; and requests to a node."""

import re
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from camera_node.commands.adjust import ChangeSettings, SaveSnapshot
from camera_node.commands.publish import open_source
from camera_node.detection.detector import Detector
from camera_node.detection.overlay import GREEN, draw_preview
from camera_node.foundation.errors import ConfigError, NetworkError
from camera_node.node.node import Node
from camera_node.node.preview import MAX_SHARE, PreviewPublisher, encode_preview
from camera_node.protocol.camera_requests import mask_of, next_detections, request_settings
from camera_node.protocol.messages import (
    MAX_BYTES,
    MAX_PREVIEW_BYTES,
    Keys,
    MessageError,
    Preview,
    decode,
    encode,
    jpeg_size,
)
from camera_node.protocol.requests import encode_jpeg
from camera_node.protocol.server_connection import Connection
from camera_node.sources.frame import SourceSettings
from tests.camera_node.node.picture import CENTRE, render
from tests.waiting import in_thread, patient, wait_for

KEYS = Keys("arena")
SIZE = st.integers(1, 900)


@pytest.fixture
def node(network, tmp_path: Path) -> Iterator[Node]:
    """A node that sends a roundel ten times a second."""
    network.router()
    folder = tmp_path / "frames"
    folder.mkdir()
    cv2.imwrite(str(folder / "0.png"), render())
    for k in range(1, 600):
        (folder / f"{100_000_000 * k}.png").symlink_to(folder / "0.png")
    node = Node("cam0", open_source(str(folder), SourceSettings(stamps="now")), Detector(), network.client())
    with in_thread(node.run, node.close):
        yield node


def test_pictures_are_sent_only_while_someone_subscribes(network, inbox, node: Node):
    """A subscriber of all keys, as the recorder is, asks for none; the last watcher's end stops them."""
    client, everything, pictures = network.client(), inbox(), inbox()
    client.declare_subscriber("arena/**", lambda sample: everything.put(str(sample.key_expr)))
    assert everything.until(lambda keys: keys.count(KEYS.detections("cam0")) >= 10)
    assert not any("@preview" in key for key in everything.items)
    watcher = client.declare_subscriber(
        KEYS.preview(), lambda s: pictures.put(decode(s.payload.to_bytes(), Preview))
    )
    assert pictures.until(lambda items: len(items) >= 3)
    preview = pictures.items[-1]
    assert (preview.camera, preview.width, preview.height) == ("cam0", 320, 240)
    assert jpeg_size(preview.jpeg) == (320, 240)
    watcher.undeclare()
    wait_for(lambda: node._previews is not None and not node._previews._is_watched.is_set())


def test_the_cost_is_bounded(network):
    """A picture of any cost is followed by a pause that keeps the share of a core below the limit."""
    image = np.random.default_rng(1).integers(0, 255, (1600, 2400), np.uint8)
    roundels, begun = Detector().detect(image), time.monotonic()
    client = network.router()
    used_s: list[float] = []
    client.declare_subscriber("a/@p", lambda _: None)

    def latest():
        used_s.append(time.monotonic())
        return image, roundels, ()

    publisher = PreviewPublisher(client, "a/@p", "cam0", latest, lambda: 0)
    wait_for(lambda: len(used_s) >= 4)
    publisher.close()
    cost_s = min(_seconds(lambda: encode_preview(image, roundels)) for _ in range(3))
    assert min(np.diff(used_s)) >= min(0.3, cost_s / MAX_SHARE)
    assert time.monotonic() - begun < patient(30)


def _seconds(act: Callable[[], object]) -> float:
    begun = time.thread_time()
    act()
    return time.thread_time() - begun


def test_the_drawn_ellipse_is_where_the_roundel_is():
    """In a picture of a third of the size: the mean of the green pixels is the roundel's centre, to half a pixel."""
    image = np.pad(render(), ((0, 0), (0, 640)), mode="edge")
    picture = draw_preview(image, Detector().detect(image), (), 320)
    assert picture.shape == (80, 320, 3)
    green = np.argwhere((np.abs(picture.astype(int) - GREEN) < 60).all(axis=2)).mean(axis=0)[::-1]
    assert np.linalg.norm(3 * (green + 0.5) - 0.5 - CENTRE) < 3 * 0.5


@given(SIZE, SIZE)
def test_the_size_of_a_jpeg_is_read_without_decoding(width: int, height: int):
    for image in (np.zeros((height, width), np.uint8), np.zeros((height, width, 3), np.uint8)):
        assert jpeg_size(cv2.imencode(".jpg", image)[1].tobytes()) == (width, height)


@given(st.binary(max_size=200))
def test_other_bytes_have_no_size(data: bytes):
    """Also where they begin as a JPEG does; reading ends."""
    assert jpeg_size(data) is None or data.startswith(b"\xff\xd8")
    jpeg_size(b"\xff\xd8\xff\xe0" + data)


def test_a_picture_that_declares_a_huge_image_is_refused():
    """A browser would allocate gigabytes for it."""
    jpeg = bytearray(cv2.imencode(".jpg", np.zeros((8, 8), np.uint8))[1].tobytes())
    at = jpeg.index(b"\xff\xc0") + 5
    jpeg[at : at + 4] = b"\xff\xff\xff\xff"
    for data in (bytes(jpeg), b"", b"GIF89a", b"\xff\xd8" + bytes(MAX_PREVIEW_BYTES)):
        with pytest.raises(MessageError, match="no small JPEG"):
            decode(encode(Preview(camera="a", t_ns=0, width=8, height=8, jpeg=data)), Preview)


def test_a_noisy_image_still_fits():
    image = np.random.default_rng(0).integers(0, 255, (2000, 320), np.uint8)
    assert 0 < len(encode_preview(image, Detector().detect(np.zeros((9, 9), np.uint8)))) <= MAX_PREVIEW_BYTES


def test_a_noisy_snapshot_is_sent_in_a_lower_quality():
    """The network carries no larger message; a small picture keeps the quality that was asked for."""
    image = np.random.default_rng(0).integers(0, 255, (2400, 2400), np.uint8)
    assert MAX_BYTES / 4 < len(encode_jpeg(image, 100)) <= MAX_BYTES
    wanted = cv2.imencode(".jpg", image[:500], [cv2.IMWRITE_JPEG_QUALITY, 100])[1].tobytes()
    assert encode_jpeg(image[:500], 100) == wanted


def test_masking_what_is_detected_silences_it(network, node: Node, tmp_path: Path, capsys):
    """By the command; then the node detects nothing there, and the mask can be removed."""
    client, server = network.client(), Connection(connect=(network.endpoint,))
    wait_for(lambda: _detects(client), deadline_s=20)
    ChangeSettings(name="cam0", mask_detected=True, min_contrast=30.0, connection=server).run()
    printed = capsys.readouterr().out
    assert "mask: 1 polygons" in printed
    assert "min_contrast: 30" in printed
    wait_for(lambda: not _detects(client), deadline_s=20)
    ChangeSettings(name="cam0", clear_mask=True, connection=server).run()
    wait_for(lambda: _detects(client), deadline_s=20)
    assert request_settings(client, "arena", "cam0").mask == ()


def test_a_drawn_mask_silences_what_is_in_it(network, node: Node, capsys):
    """Two corners are a rectangle; a mask beside the roundel changes nothing; both are refused without an area."""
    client, server = network.client(), Connection(connect=(network.endpoint,))
    wait_for(lambda: _detects(client), deadline_s=20)
    u, v = next_detections(client, "arena", "cam0").unpack().uv[0]
    ChangeSettings(name="cam0", mask=(f"{u + 60},{v + 60}", f"{u + 80},{v + 70}"), connection=server).run()
    wait_for(lambda: _detects(client), deadline_s=20)
    ChangeSettings(name="cam0", mask=(f"{u - 9},{v - 9}", f"{u + 9},{v + 9}"), connection=server).run()
    assert "mask: 2 polygons" in capsys.readouterr().out
    wait_for(lambda: not _detects(client), deadline_s=20)
    for corners in (("1,1",), ("1,1", "1,9"), ("nan,1", "5,9"), ("1,1", "5")):
        with pytest.raises(ConfigError):
            ChangeSettings(name="cam0", mask=corners, connection=server).run()


def _detects(client) -> bool:
    return len(next_detections(client, "arena", "cam0")) > 0


def test_a_mask_covers_the_detection_and_little_more(network, node: Node):
    """Each corner is 1.5 radii or more away from the centre, and less than 1.7."""
    client = network.client()
    wait_for(lambda: _detects(client), deadline_s=20)
    (polygon,) = mask_of(next_detections(client, "arena", "cam0"))
    distance = np.linalg.norm(np.array(polygon) - CENTRE, axis=1) / 24
    assert ((distance > 1.5) & (distance < 1.7)).all()


def test_a_snapshot_is_saved(network, node: Node, tmp_path: Path):
    server, out = Connection(connect=(network.endpoint,)), tmp_path / "seen.jpg"
    wait_for(lambda: node._statistics.latest)
    SaveSnapshot(name="cam0", out=out, draw=True, connection=server).run()
    assert jpeg_size(out.read_bytes()) == (320, 240)
    with pytest.raises(ConfigError, match="does its folder exist"):
        SaveSnapshot(name="cam0", out=tmp_path / "no" / "x.jpg", connection=server).run()


def test_an_absent_camera_is_answered_with_those_that_run(network, node: Node):
    """The name that the error proposes is a camera's."""
    client = network.client()
    wait_for(lambda: request_settings(client, "arena", "cam0"))
    with pytest.raises(NetworkError, match="there is no camera 'cam9', but cam0; did you mean cam0") as error:
        request_settings(client, "arena", "cam9", timeout_s=0.2)
    proposed = re.findall(r"did you mean (\w+)\?", str(error.value))
    assert request_settings(client, "arena", *proposed) == request_settings(client, "arena", "cam0")
    with pytest.raises(NetworkError, match="a Zenoh router answers there, but no arena's server"):
        request_settings(client, "lab", "cam9", timeout_s=0.2)
