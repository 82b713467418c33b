# SPDX-License-Identifier: BSD-3-Clause
"""An exception of one task, stage or callback ends nothing, and is counted, logged and answered."""

import logging
from collections.abc import Callable
from pathlib import Path

import pytest

from camera_node.protocol.requests import respond
from fusion.protocol.pose_messages import RobotPose
from fusion.server.transport import INTERNAL_ERROR
from tests.fusion.serving import ARENA, config, later, live, send, send_until_tracked, serving
from tests.waiting import DEADLINE_S, Inbox, wait_for


def raise_error(*_: object) -> None:
    raise ValueError("a bug that some input shows")


@pytest.mark.parametrize(
    "stage", ["a task", "tracking", "association", pytest.param("the status", marks=pytest.mark.ci)]
)
def test_the_server_continues_after_any_exception(tmp_path: Path, caplog, stage: str):
    """Before: the server's loop ended with the first exception that was not of NumPy or GTSAM."""
    with serving(config(tmp_path)) as (server, client):
        frames = live(ARENA.messages(12))
        send_until_tracked(server, client, frames)
        tracker = server.pipeline.tracker
        faulty: dict[str, Callable[[], object]] = {
            "a task": raise_error,
            "tracking": lambda: setattr(tracker, "finish", raise_error),
            "association": lambda: setattr(tracker, "associate", raise_error),
            "the status": lambda: setattr(server.statistics, "_reset", raise_error),
        }
        server.transport.enqueue(faulty[stage])
        send(server, later(frames))
        if stage == "the status":
            wait_for(lambda: "the status failed" in caplog.text)
            server.transport.enqueue(lambda: delattr(server.statistics, "_reset"))

        def is_counted() -> bool:
            send(server, later(frames))  # those of the same period are refused as duplicates
            faults = client.status(DEADLINE_S).next().faults
            return bool(faults.keys() & {INTERNAL_ERROR, "frame set without a solution"})

        wait_for(is_counted)
        assert "a bug that some input shows" in caplog.text
        send_until_tracked(server, client, frames)


def test_a_request_that_fails_is_answered_at_once(tmp_path: Path, caplog):
    """Before: its sender waited for the timeout."""
    with serving(config(tmp_path)) as (server, client):
        server.transport.answer_on_server_thread("test/broken", lambda query: raise_error() or b"")
        reply = wait_for(lambda: next(iter(client.session.get("test/broken", timeout=DEADLINE_S)), None))
        assert reply is not None
        assert reply.err is not None
        assert "internal error (ValueError)" in reply.err.payload.to_string()
        assert respond.__name__ in caplog.text


def test_a_callback_that_fails_does_not_affect_the_others(tmp_path: Path, caplog):
    poses = Inbox()
    with serving(config(tmp_path)) as (server, client), caplog.at_level(logging.ERROR):
        client.robot("a").on_pose(raise_error)
        client.robot("a").on_pose(poses.put)
        frames = live(ARENA.messages(12))
        send(server, frames)
        assert poses.until(lambda items: len(items) > 3)
    assert all(isinstance(pose, RobotPose) for pose in poses.items)
    assert "a callback for pose of 'a'" in caplog.text
