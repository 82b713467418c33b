# SPDX-License-Identifier: BSD-3-Clause
"""Detections are collected past invalid messages, and subscribers receive the published rig."""

import threading

import pytest

from calib.errors import CalibrationError
from calib.live.collect import collect_with_progress, publish_rig
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
        collected = collect_with_progress(client, "test", 3.0, "collecting")
        thread.join(10)
        assert (len(collected.messages), collected.invalid) == (len(messages), 1)
        assert publish_rig(client, "test", arena.truth)
        assert arrived.wait(10)
        assert rigs[0].yaml == dump_rig(arena.truth)


def test_no_detections_is_an_error_that_names_the_key(endpoint: str):
    with open_client([endpoint]) as client, pytest.raises(CalibrationError, match="no detections on test/"):
        collect_with_progress(client, "test", 0.1, "collecting")
