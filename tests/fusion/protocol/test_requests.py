# SPDX-License-Identifier: BSD-3-Clause
"""Requests to a running server: changes of robots, and the file that survives a restart."""

import json
import os

import msgspec

from camera_node.protocol.messages import decode, encode
from fusion.protocol.messages import Robots, RobotsRequest, robots_key, set_robots_key
from tests.fusion.serving import ARENA, DEADLINE_S, config, live, send, serving, until
from tests.fusion.synthetic import WIDE


def request_reply(client, key: str, payload: bytes = b"") -> tuple[bytes | None, str]:
    """The reply, or the text of the error."""
    for reply in client._session.get(key, payload=payload, timeout=DEADLINE_S):
        if reply.ok is not None:
            return reply.ok.payload.to_bytes(), ""
        return None, reply.err.payload.to_string()
    raise AssertionError("no reply")


def robots_of(data: bytes | None) -> Robots:
    assert data is not None
    return decode(data, Robots)


def test_robots_are_defined_renamed_and_removed_while_tracked(tmp_path):
    with serving(config(tmp_path)) as (server, client):
        key = robots_key("test")
        send(server, live(ARENA.messages(30)))
        until(lambda: client.robot("a", DEADLINE_S).next().state == "tracked")
        assert set(robots_of(request_reply(client, key)[0]).robots) == {"a"}
        request = RobotsRequest(rename={"a": "rover"}, define={"wide": WIDE})
        change = set_robots_key("test")
        assert list(robots_of(request_reply(client, change, encode(request))[0]).robots) == ["rover", "wide"]
        assert server.pipeline.tracker is not None
        assert server.pipeline.tracker.table.status == ["tracked", None]
        reply, _ = request_reply(client, change, json.dumps({"remove": ["wide"]}).encode())
        assert reply is not None
        assert list(json.loads(reply)["robots"]) == ["rover"]


def test_an_invalid_change_of_robots_changes_nothing(tmp_path):
    twin = msgspec.structs.replace(ARENA.robots["a"], start_m=None)
    faults = {
        b"\x00\xff": "RobotsRequest",
        b'{"colour": 1}': "colour",
        encode(RobotsRequest(remove=("b",))): "there is no robot 'b'",
        encode(RobotsRequest(define={"b/c": WIDE})): "can't name a robot",
        encode(RobotsRequest(define={"b": twin})): "identical",
    }
    with serving(config(tmp_path)) as (server, client):
        for payload, said in faults.items():
            reply, error = request_reply(client, set_robots_key("test"), payload)
            assert reply is None
            assert said in error
        assert list(server.pipeline.robots) == ["a"]


def test_the_key_for_reading_robots_changes_none(tmp_path):
    """Access rights by key depend on this."""
    with serving(config(tmp_path)) as (server, client):
        reply, error = request_reply(client, robots_key("test"), b'{"remove": ["a"]}')
        assert (reply, error) == (None, "send changes of robots to test/robots/set")
        reply, _ = request_reply(client, robots_key("test"), b"{}")
        assert reply is not None
        assert list(json.loads(reply)["robots"]) == list(server.pipeline.robots) == ["a"]


def test_changed_robots_are_used_after_a_restart(tmp_path):
    """Even if no robot is left; but a file that the user wrote later has precedence."""
    settings = msgspec.structs.replace(config(tmp_path), saved_robots=str(tmp_path / "robots.saved.yaml"))
    requests = (RobotsRequest(define={"wide": WIDE}, rename={"a": "b"}), RobotsRequest(remove=("b", "wide")))
    before = {"a"}
    for request, after in zip(requests, ({"b", "wide"}, set()), strict=True):
        with serving(settings) as (server, client):
            assert set(server.pipeline.robots) == before
            assert (
                set(robots_of(request_reply(client, set_robots_key("test"), encode(request))[0]).robots)
                == after
            )
        before = after
    with serving(settings) as (server, _):
        assert not server.pipeline.robots
    later = (tmp_path / "robots.saved.yaml").stat().st_mtime_ns + 10**9
    os.utime(settings.robots, ns=(later, later))
    with serving(settings) as (server, _):
        assert set(server.pipeline.robots) == {"a"}
