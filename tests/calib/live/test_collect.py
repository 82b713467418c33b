# SPDX-License-Identifier: BSD-3-Clause
"""Live calibration: detections are collected past bytes that are none, and the rig reaches who listens."""

import threading

import pytest

from calib.errors import CalibrationError
from calib.live.collect import collect, publish
from calib.rig.messages import RigMessage
from calib.rig.rig import dump_rig
from camera_node.protocol.messages import Keys, decode, encode
from camera_node.protocol.session import open_client, open_router
from tests.calib.synthetic import record, ring


def test_collects_and_publishes(endpoint: str):
    arena = ring()
    messages = record(arena, 1.0)
    keys = Keys("test")
    with open_router([endpoint]) as router, open_client([endpoint]) as client:
        arrived, listening = threading.Event(), threading.Event()
        rigs: list[RigMessage] = []
        router.declare_subscriber(
            keys.rig, lambda s: (rigs.append(decode(s.payload.to_bytes(), RigMessage)), arrived.set())
        )
        sender = router.declare_publisher(keys.detections("cam0"))
        sender.declare_matching_listener(lambda status: listening.set())

        def send() -> None:
            assert listening.wait(10)
            sender.put(b"no message")
            for message in messages:
                sender.put(encode(message))

        thread = threading.Thread(target=send)
        thread.start()
        heard = collect(client, "test", 3.0, "looking")
        thread.join(10)
        assert (len(heard.messages), heard.bad) == (len(messages), 1)
        assert publish(client, "test", arena.truth)
        assert arrived.wait(10)
        assert rigs[0].yaml == dump_rig(arena.truth)


def test_silence_is_a_fault_with_advice(endpoint: str):
    with open_client([endpoint]) as client, pytest.raises(CalibrationError, match="no detections on test/"):
        collect(client, "test", 0.1, "looking")
