# SPDX-License-Identifier: BSD-3-Clause
"""Requests to a running server: changes of robots, and the file that survives a restart."""

import json
import os
from pathlib import Path

import msgspec
import pytest
import zenoh

from camera_node.foundation.errors import NetworkError
from camera_node.protocol.messages import decode, encode
from camera_node.protocol.requests import send_request
from camera_node.protocol.session import open_client, open_router
from fusion.client.robot_definition import LOST_AT_RESTART
from fusion.errors import FusionError
from fusion.model.robots import load_robots
from fusion.protocol.pose_messages import Robots, RobotsRequest, robots_key, set_robots_key
from fusion.tracking.tracker import PAUSED
from tests.fusion.serving import ARENA, KEYS, config, later, live, send, send_until_tracked, serving
from tests.fusion.synthetic import WIDE
from tests.processes import run_program
from tests.waiting import DEADLINE_S, wait_for


def request_reply(client, key: str, payload: bytes = b"") -> tuple[bytes | None, str]:
    """The reply, or the text of the error."""
    for reply in client.session.get(key, payload=payload, timeout=DEADLINE_S):
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
        send_until_tracked(server, client, ARENA.messages(30))
        assert set(robots_of(request_reply(client, key)[0]).robots) == {"a"}
        request = RobotsRequest(rename={"a": "rover"}, define={"wide": WIDE})
        change = set_robots_key("test")
        assert list(robots_of(request_reply(client, change, encode(request))[0]).robots) == ["rover", "wide"]
        assert server.pipeline.tracker is not None
        assert server.pipeline.tracker.table.status == ["tracked", None]
        reply, _ = request_reply(client, change, json.dumps({"remove": ["wide"]}).encode())
        assert reply is not None
        assert list(json.loads(reply)["robots"]) == ["rover"]


def test_a_server_that_hangs_does_not_refuse(endpoint):
    """Zenoh ends a query whose answer does not come by an error reply of its own, "Timeout"."""
    held: list[zenoh.Query] = []
    with open_router([endpoint]) as router, open_client([endpoint]) as client:
        queryable = router.declare_queryable(set_robots_key("test"), held.append)
        with pytest.raises(NetworkError, match="no server answers on test/robots/set within 1 s"):
            send_request(client, set_robots_key("test"), encode(RobotsRequest()), timeout_s=1.0, answer_s=1.0)
        assert held
        held.clear()  # before the session closes
        queryable.undeclare()


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


def test_a_robot_is_not_overwritten_unless_asked(tmp_path):
    """The robots that a restart would lose are named, also in the status."""
    with serving(config(tmp_path)) as (server, client):
        client.change_robots(define={"b": WIDE})
        other = msgspec.structs.replace(WIDE, motion="ground")
        with pytest.raises(
            FusionError, match=r"there is another robot 'b': use another name, or .*--replace"
        ):
            client.change_robots(define={"b": other})
        assert server.pipeline.robots["b"] == WIDE
        assert client.change_robots(define={"b": other}, replace=True)["b"] == other
        client.change_robots(rename={"a": "c"})
        assert client.declared_robots().unsaved == ("a", "b", "c")
        wait_for(lambda: client.status(DEADLINE_S).next().unsaved_robots == ("a", "b", "c"))


def test_the_robots_command_lists_renames_removes_and_saves(tmp_path):
    def robots(*words: str) -> tuple[int, str]:
        done = run_program("fusion", "robots", *words, *where)
        return done.returncode, done.stdout + done.stderr

    with serving(config(tmp_path)) as (server, client):
        where = ["--connect", server.endpoints[0], "--arena", "test"]
        assert robots("rename", "a", "rover") == (
            0,
            f"rover: 3 markers of 0.12 m; {LOST_AT_RESTART}\n"
            "a: removed; a restart of the server brings it back, because arena.yaml names no saved_robots\n",
        )
        path = tmp_path / "mine.yaml"
        assert robots("save", str(path)) == (0, f"wrote 1 robots to {path}\n")
        assert load_robots(path) == client.declared_robots().robots
        code, said = robots("save", str(path))
        assert code == 2
        assert "exists; add --force" in said
        assert robots("remove", "rover")[0] == 0
        assert "rover" not in robots("list")[1]


def test_no_robot_is_acquired_while_a_wand_is_recorded(tmp_path):
    """Another program declares the token, as calib does while it records; it is counted until that ends."""
    with serving(config(tmp_path)) as (server, client):
        wand = client.session.liveliness().declare_token(KEYS.wand)
        wait_for(lambda: client.status(DEADLINE_S).next().not_acquired == {"a": PAUSED})
        first = live(ARENA.messages(30))
        send(server, first)
        wait_for(lambda: client.status(DEADLINE_S).next().frame_sets_per_s > 0)
        assert server.pipeline.tracker is not None
        assert server.pipeline.tracker.table.status == [None]
        wand.undeclare()
        wait_for(lambda: client.status(DEADLINE_S).next().not_acquired.get("a") != PAUSED)
        send(server, later(first))
        wait_for(lambda: client.robot("a", DEADLINE_S).next().state == "tracked")


def test_the_key_for_reading_robots_changes_none(tmp_path):
    """Access rights by key depend on this."""
    with serving(config(tmp_path)) as (server, client):
        reply, error = request_reply(client, robots_key("test"), b'{"remove": ["a"]}')
        assert (reply, error) == (None, "send changes of robots to test/robots/set")
        reply, _ = request_reply(client, robots_key("test"), b"{}")
        assert reply is not None
        assert list(json.loads(reply)["robots"]) == list(server.pipeline.robots) == ["a"]


def test_changed_robots_are_used_after_a_restart(tmp_path):
    """Even if no robot is left; but a file that the user changed later has precedence, and the other one is kept."""
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
    given, saved = Path(settings.robots), tmp_path / "robots.saved.yaml"
    os.utime(given, (4e9, 4e9))  # as by a copy
    with serving(settings) as (server, _):
        assert not server.pipeline.robots
    given.write_text(f"{given.read_text()}# edited\n")
    os.utime(given, (0, 0))
    old = saved.read_text()
    with serving(settings) as (server, client):
        assert set(server.pipeline.robots) == {"a"}
        request_reply(client, set_robots_key("test"), encode(RobotsRequest(define={"wide": WIDE})))
    assert (tmp_path / "robots.saved.1.yaml").read_text() == old
    with serving(settings) as (server, _):
        assert set(server.pipeline.robots) == {"a", "wide"}


def test_what_a_user_edits_while_the_server_runs_is_not_overwritten(tmp_path):
    """The change over the network comes on top of the edit, or is refused while the file is broken."""
    path = tmp_path / "one.yaml"
    settings = msgspec.structs.replace(config(tmp_path), robots=str(path), saved_robots=str(path))
    key = set_robots_key("test")
    with serving(settings) as (server, client):
        for name in ("wide", "other"):
            robot = msgspec.structs.replace(WIDE, start_m=(float(name == "wide"), 0.0, 0.0))
            request_reply(client, key, encode(RobotsRequest(define={name: robot})))
        path.write_text(path.read_text().replace("wide:", "edited:"))
        reply, _ = request_reply(client, key, encode(RobotsRequest(rename={"other": "third"})))
        assert set(robots_of(reply).robots) == set(server.pipeline.robots) == {"edited", "third"}
        assert set(load_robots(path)) == {"edited", "third"}
        broken = path.read_text() + "robots: {"
        path.write_text(broken)
        reply, error = request_reply(client, key, encode(RobotsRequest(remove=("third",))))
        assert reply is None
        assert f"{path} was edited while the server runs, and can't be used" in error
        assert path.read_text() == broken
        assert set(server.pipeline.robots) == {"edited", "third"}


def test_one_file_of_robots_for_the_user_and_the_server(tmp_path):
    """As in the folder of `roundel up`: it may be missing, the server writes it, and an editor may change it."""
    path = tmp_path / "one.yaml"
    settings = msgspec.structs.replace(config(tmp_path), robots=str(path), saved_robots=str(path))
    request = encode(RobotsRequest(define={"wide": WIDE}))
    with serving(settings) as (server, client):
        assert not server.pipeline.robots
        reply = robots_of(request_reply(client, set_robots_key("test"), request)[0])
        assert (set(reply.robots), reply.unsaved) == ({"wide"}, ())
    path.write_text(path.read_text().replace("wide:", "edited:"))
    with serving(settings) as (server, _):
        assert set(server.pipeline.robots) == {"edited"}
