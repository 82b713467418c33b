# SPDX-License-Identifier: BSD-3-Clause
"""The live server and its client over Zenoh on loopback."""

import asyncio
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import msgspec
import numpy as np
import pytest

from calib.rig.messages import RigMessage
from calib.rig.rig import Rig, save_rig
from camera_node.errors import NetworkError
from camera_node.protocol.messages import ClockReply, Detections, Keys, decode, encode
from fusion.client.arena import Arena as Client
from fusion.model.limits import Limits
from fusion.server.config import ArenaConfig
from fusion.server.server import Server
from tests.conftest import ROOT, free_port
from tests.fusion.synthetic import TRIANGLE, Arena, line

DEADLINE_S = 60.0  # for busy machines; nothing waits so long when all is well
ARENA = Arena({"a": TRIANGLE}, {"a": line((0.2, 0.1, 0.2), tilt=(0.1, 0.0, 0.3))}, sigma_px=0.05)
KEYS = Keys("test")


def config(folder: Path, with_rig: bool = True) -> ArenaConfig:
    save_rig(Rig(cameras=ARENA.cameras), folder / "rig.yaml")
    (folder / "robots.yaml").write_bytes(
        msgspec.yaml.encode({"robots": {"a": msgspec.to_builtins(TRIANGLE)}})
    )
    rig = str(folder / "rig.yaml") if with_rig else None
    return ArenaConfig(
        arena="test",
        listen=(f"tcp/127.0.0.1:{free_port()}",),
        rig=rig,
        robots=str(folder / "robots.yaml"),
        limits=Limits(lateness_ms=5000),  # frames are sent in one burst: every instant waits to be complete
    )


@contextmanager
def serving(settings: ArenaConfig) -> Iterator[tuple[Server, Client]]:
    with Server(settings) as server:
        thread = threading.Thread(target=server.run)
        thread.start()
        try:
            with Client.connect(*settings.listen, arena="test") as client:
                until(lambda: list(client._session.get(KEYS.clock, timeout=1.0)))
                yield server, client
        finally:
            server.stop()
            thread.join(DEADLINE_S)


def until(met):
    """The first true value of `met()`, polled; each poll blocks on the network by itself."""
    deadline = time.monotonic() + DEADLINE_S
    while time.monotonic() < deadline:
        if value := met():
            return value
    raise AssertionError("the deadline passed")


def live(messages: list[Detections], ago_ns: int = 10**9) -> list[Detections]:
    """The messages as if their first frame was taken `ago_ns` ago."""
    shift = time.time_ns() - ago_ns - messages[0].t_ns
    return [msgspec.structs.replace(m, t_ns=m.t_ns + shift, sent_ns=m.t_ns + shift) for m in messages]


def send(server: Server, messages: list[Detections]) -> None:
    """Hand messages to the server's own session, as cameras would; its queue keeps their order."""
    for message in messages:
        server.session.put(KEYS.detections(message.camera), encode(message))


def test_detections_become_poses_and_markers(tmp_path):
    with serving(config(tmp_path)) as (server, client):
        robot, markers = client.robot("a", DEADLINE_S), client.markers(DEADLINE_S)
        called = threading.Event()
        robot.on_pose(lambda pose: called.set())
        markers_came = threading.Event()
        markers.on_message(lambda m: markers_came.set())
        status = client.status(DEADLINE_S)
        send(server, live(ARENA.messages(30)))
        assert called.wait(DEADLINE_S)
        assert markers_came.wait(DEADLINE_S)
        until(lambda: status.next().cameras.keys() == ARENA.cameras.keys())
        pose = robot.latest()
        assert pose is not None
        assert np.abs(np.subtract(pose.position, (0.2, 0.1, 0.2))).max() < 3e-3
        assert client.robots() == ("a",)
        assert pose.latency is None or pose.latency.total_ms > 0


def test_what_is_no_detection_is_counted_and_skipped(tmp_path):
    good = live(ARENA.messages(1))
    old = msgspec.structs.replace(good[0], t_ns=1)
    stranger = msgspec.structs.replace(good[0], camera="other")
    small = msgspec.structs.replace(good[1], width=64)
    with serving(config(tmp_path)) as (server, client):
        status = client.status(DEADLINE_S)
        for data in (b"", b"\x00\xff" * 50, encode(good[0])[:40], encode(stranger)):
            server.session.put(KEYS.detections("cam0"), data)
        send(server, [old, stranger, small])
        expected = {
            "detections that are no message": 4,
            "implausible time": 1,
            "unknown camera": 1,
            "wrong image size": 1,
        }
        until(lambda: status.next().faults == expected)


def test_an_instant_without_a_solution_costs_the_robots_but_not_the_server(tmp_path):
    with serving(config(tmp_path)) as (server, client):
        send(server, live(ARENA.messages(12)))
        until(lambda: client.robot("a", DEADLINE_S).next().state == "tracked")
        assert server._tracker is not None
        tracker = server._tracker
        server.link.put(lambda: tracker.states.P.fill(np.nan))
        status = client.status(DEADLINE_S)
        send(server, live(ARENA.messages(12), ago_ns=5 * 10**8))
        until(lambda: status.next().faults == {"instant that could not be solved": 1})
        send(server, live(ARENA.messages(12), ago_ns=4 * 10**8))
        until(lambda: client.robot("a", DEADLINE_S).next().state == "tracked")


def test_a_clock_that_is_set_back_begins_everything_anew(tmp_path, caplog):
    with serving(config(tmp_path)) as (server, _):
        before = server._tracker
        server.link.put(lambda: setattr(server, "_now_ns", time.time_ns() + 3600 * 10**9))
        until(lambda: server._tracker is not before)
    assert "clock was set back" in caplog.text


def in_time(server: Server, frames: int) -> None:
    """Frames of all cameras, each at hand when it is taken, thirty a second."""
    pause = threading.Event()
    for k in range(frames):
        t_ns, rest = time.time_ns(), ARENA.messages(1)
        send(server, [msgspec.structs.replace(m, seq=k, t_ns=t_ns, sent_ns=t_ns) for m in rest])
        pause.wait(1 / 30)


@pytest.mark.parametrize(("behind_ns", "drops"), [(60 * 10**9, False), (0, True)])
def test_what_waits_for_the_server_is_late_only_if_it_is_far_behind(tmp_path, monkeypatch, behind_ns, drops):
    """Frames came in time, and the server was busy meanwhile with something else."""
    monkeypatch.setattr("fusion.server.server.BEHIND_NS", behind_ns)
    settings = msgspec.structs.replace(config(tmp_path), limits=Limits(lateness_ms=50))
    with Server(settings) as server, Client.connect(*settings.listen, arena="test") as client:
        until(lambda: list(client._session.get(KEYS.clock, timeout=1.0)))
        poses = []
        client.robot("a").on_pose(poses.append)
        in_time(server, 30)
        thread = threading.Thread(target=server.run)
        thread.start()
        try:
            until(lambda: client.status(DEADLINE_S).next().instants_per_s > 0)
            assert (sum(server._instants.late.values()) > 0) == drops
            assert drops or any(pose.state == "tracked" for pose in poses)
        finally:
            server.stop()
            thread.join(DEADLINE_S)


def test_a_calibration_that_arrives_is_applied_and_a_bad_one_is_not(tmp_path):
    with serving(config(tmp_path, with_rig=False)) as (server, client):
        assert client.rig(DEADLINE_S) is None
        good = encode(RigMessage.of(Rig(cameras=ARENA.cameras)))
        bad = encode(RigMessage(t_ns=0, yaml="cameras: {cam0: [1, 2"))
        server.session.put(KEYS.rig, good)
        rig = until(lambda: client.rig(DEADLINE_S))
        assert rig.cameras.keys() == ARENA.cameras.keys()
        server.session.put(KEYS.rig, bad)
        until(lambda: client.status(DEADLINE_S).next().faults == {"rig that is no rig": 1})
        assert client.rig(DEADLINE_S) is not None


def test_the_clock_is_answered(tmp_path):
    with serving(config(tmp_path)) as (_, client):
        replies = client._session.get(KEYS.clock, timeout=DEADLINE_S)
        data = next(reply.ok.payload.to_bytes() for reply in replies if reply.ok is not None)
        t_ns = decode(data, ClockReply).t_ns
        assert abs(t_ns - time.time_ns()) < 5e9


def test_a_taken_port_is_said(tmp_path):
    settings = config(tmp_path)
    with serving(settings), pytest.raises(NetworkError, match="can't listen on"), Server(settings):
        pass


def test_a_client_waits_no_longer_than_it_was_told(tmp_path):
    with serving(config(tmp_path)) as (_, client):
        with pytest.raises(NetworkError, match="no pose of 'nobody'"):
            next(iter(client.robot("nobody", timeout_s=0.05)))
        assert client.robot("nobody").latest() is None


def test_poses_can_be_awaited_and_iterated(tmp_path):
    with serving(config(tmp_path)) as (server, client):
        ready = threading.Event()
        send_later = threading.Thread(target=lambda: ready.wait() and send(server, live(ARENA.messages(40))))
        send_later.start()

        async def first():
            ready.set()
            async for pose in client.robot("a", DEADLINE_S):
                return pose.robot

        assert asyncio.run(first()) == "a"
        send_later.join(DEADLINE_S)


def test_bytes_that_are_no_pose_are_counted(tmp_path):
    with serving(config(tmp_path)) as (server, client):
        server.session.put(KEYS.robot_pose("a"), b"nonsense")
        status = client.status(DEADLINE_S)
        until(lambda: status.next() and client.faults["RobotPose"] == 1)


def test_a_client_needs_neither_gtsam_nor_scipy():
    code = "import fusion.client.arena, sys; sys.exit(bool({'gtsam', 'scipy', 'viser'} & set(sys.modules)))"
    root = ROOT
    assert subprocess.run([sys.executable, "-c", code], cwd=root, timeout=120).returncode == 0
