# SPDX-License-Identifier: BSD-3-Clause
"""A node uses its camera's lens of the rig in force, over Zenoh."""

import threading
from collections.abc import Iterator

import numpy as np
import pytest

from calib.rig.camera import Camera
from calib.rig.rig import Rig
from calib.rig.rig_messages import RigMessage
from camera_node.detection.detector import Detector
from camera_node.detection.known_lens import KnownLens
from camera_node.detection.roundels import DetectedRoundels
from camera_node.foundation.arrays import Grey
from camera_node.node.node import Node
from camera_node.node.rig_lens import RigLens
from camera_node.protocol.messages import Detections, Keys, decode, encode
from camera_node.sources.frame import Frame, Source
from tests.camera_node.tracing import Sight, trace
from tests.waiting import in_thread

KEYS = Keys("arena")
LENS = Camera(width=120, height=90, fx=300.0, fy=300.0, cx=59.5, cy=44.5, distortion=(-0.1, 0.0, 0.0, 0.0))
SIZE = (LENS.width, LENS.height)


def picture() -> Grey:
    """A tilted roundel of 40 px on white."""
    clean = trace(Sight(LENS, (70.2, 40.6), 0.75, tilt=0.6, turn=0.9, ground=190.0), 4)
    return np.round(clean + 2 * np.random.default_rng(0).standard_normal(clean.shape)).astype(np.uint8)


@pytest.fixture(scope="module")
def found() -> DetectedRoundels:
    return Detector().detect(picture())


class StillCamera(Source):
    """The same picture ten times a second, until it is closed."""

    def __init__(self) -> None:
        self._closed = threading.Event()

    def __iter__(self) -> Iterator[Frame]:
        k = 0
        while not self._closed.wait(0.1):
            yield Frame(picture(), t_ns=10**18 + k * 10**8)
            k += 1

    def close(self) -> None:
        self._closed.set()


def rig_of(camera: Camera) -> bytes:
    return encode(RigMessage(t_ns=1, rig=Rig(cameras={"north": LENS, "cam0": camera})))


def is_refined(roundels, found: DetectedRoundels) -> bool:
    """Whether the claim on the centre is that of a known lens, to the rounding of the message."""
    expected = KnownLens(LENS).refine(found)
    return bool(np.allclose(roundels.cov, expected.cov, rtol=1e-5))


def test_the_lens_is_asked_for_and_followed(network, eventually, found, caplog):
    """The server is asked when it appears. A change is followed; what is no rig is counted and not logged; a rig
    without the camera, or for images of another size, leaves the detections as measured."""
    router = network.router()
    queryable = router.declare_queryable(KEYS.rig, lambda query: query.reply(KEYS.rig, rig_of(LENS)))
    session = network.client()
    refused: list[None] = []
    lens = RigLens(session, KEYS, "cam0", lambda: refused.append(None))
    assert lens.refine(found, SIZE) is found
    token = router.liveliness().declare_token(KEYS.fusion_alive)
    assert eventually(lambda: is_refined(lens.refine(found, SIZE), found))
    assert lens.refine(found, (640, 480)) is found
    publisher = router.declare_publisher(KEYS.rig)
    assert eventually(lambda: publisher.matching_status.matching)
    for rubbish in (b"\xff", b"", encode(RigMessage(t_ns=1, rig=Rig(cameras={})))[:-3], bytes(2 << 20)):
        publisher.put(rubbish)
    other = Camera(width=120, height=90, fx=200.0, fy=220.0, cx=20.0, cy=44.5)
    publisher.put(rig_of(other))
    assert eventually(lambda: not is_refined(lens.refine(found, SIZE), found))
    assert lens.refine(found, SIZE) is not found
    assert eventually(lambda: len(refused) == 4)
    assert "is not used:" not in caplog.text
    publisher.put(encode(RigMessage(t_ns=1, rig=Rig(cameras={"north": LENS}))))
    assert eventually(lambda: lens.refine(found, SIZE) is found)
    token.undeclare()
    queryable.undeclare()
    lens.close()


def test_a_lens_of_another_camera_is_reported_once(network, eventually, found, caplog):
    router, session = network.router(), network.client()
    lens = RigLens(session, KEYS, "cam0")
    publisher = router.declare_publisher(KEYS.rig)
    assert eventually(lambda: publisher.matching_status.matching)
    publisher.put(rig_of(Camera(width=120, height=90, fx=900.0, fy=500.0, cx=59.5, cy=44.5)))
    assert eventually(lambda: lens.refine(found, SIZE) is not found)
    for _ in range(50):
        lens.refine(found, SIZE)
    assert caplog.text.count("contradicts its roundels") == 1
    lens.close()


def test_a_nodes_detections_use_the_servers_lens(network, inbox, found):
    router, got = network.router(), inbox()
    router.declare_subscriber(
        KEYS.detections(), lambda sample: got.put(decode(sample.payload.to_bytes(), Detections))
    )
    router.declare_queryable(KEYS.rig, lambda query: query.reply(KEYS.rig, rig_of(LENS)))
    node = Node("cam0", StillCamera(), Detector(), network.client())
    with in_thread(node.run, node.close):
        assert got.until(len)
        free = got.items[0].unpack().cov
        token = router.liveliness().declare_token(KEYS.fusion_alive)
        assert got.until(lambda items: np.trace(items[-1].unpack().cov[0]) < 0.9 * np.trace(free[0]))
        token.undeclare()
