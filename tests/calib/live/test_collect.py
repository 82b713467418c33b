# SPDX-License-Identifier: BSD-3-Clause
"""Detections are collected from running cameras."""

import threading

import pytest

from calib.errors import CalibrationError
from calib.live.collect import collect_with_progress
from camera_node.protocol.messages import Keys, encode
from camera_node.protocol.session import open_client, open_router
from tests.calib.synthetic import record, ring
from tests.waiting import in_thread


def test_detections_are_collected_past_invalid_messages(endpoint: str):
    messages = record(ring(), 1.0)
    keys = Keys("test")
    with open_router([endpoint]) as router, open_client([endpoint]) as client:
        listening = threading.Event()
        sender = router.declare_publisher(keys.detections("cam0"))
        sender.declare_matching_listener(lambda status: listening.set())

        def send() -> None:
            assert listening.wait(10)
            sender.put(b"no message")
            for message in messages:
                sender.put(encode(message))

        with in_thread(send, listening.set):
            collected = collect_with_progress(client, "test", 3.0, "collecting")
        assert (len(collected.messages), collected.invalid) == (len(messages), 1)


def test_no_detections_is_an_error_that_names_the_arena(endpoint: str):
    with (
        open_router([endpoint]),
        open_client([endpoint]) as client,
        pytest.raises(CalibrationError, match="no camera of arena 'test' sent"),
    ):
        collect_with_progress(client, "test", 0.1, "collecting")
