# SPDX-License-Identifier: BSD-3-Clause
"""The live server and its client over Zenoh on loopback."""

import asyncio
import os
import subprocess
import sys
import threading
import time
from collections import Counter

import msgspec
import numpy as np
import pytest

from camera_node.foundation.errors import ConfigError, NetworkError
from camera_node.protocol.messages import ClockReply, decode, encode
from fusion.client.arena import Arena as Client
from fusion.model.limits import Limits
from fusion.protocol.pose_messages import FusedFrames, FusionStatus, RobotPose, RobotPoses, frames_key
from fusion.server.arena_config import in_zone, override
from fusion.server.server import Server
from fusion.server.transport import TOO_SLOW
from tests.conftest import ROOT
from tests.fusion.serving import (
    ARENA,
    ATTEMPT_S,
    KEYS,
    config,
    connected,
    later,
    live,
    running_server,
    send,
    send_until_tracked,
    serving,
    zones_of,
)
from tests.processes import running
from tests.waiting import DEADLINE_S, Inbox, wait_for


def test_detections_become_poses_and_markers(tmp_path):
    with serving(config(tmp_path)) as (server, client):
        robot, markers, status = (
            client.robot("a", DEADLINE_S),
            client.markers(DEADLINE_S),
            client.status(DEADLINE_S),
        )
        received = threading.Event(), threading.Event()
        robot.on_pose(lambda _: received[0].set())
        markers.on_message(lambda _: received[1].set())
        send(server, live(ARENA.messages(30)))
        assert all(event.wait(DEADLINE_S) for event in received)
        wait_for(lambda: status.next().cameras.keys() == ARENA.cameras.keys())
        pose = robot.latest()
        assert pose is not None
        assert np.abs(np.subtract(pose.position, (0.2, 0.1, 0.2))).max() < 3e-3
        assert client.robots() == ("a",)


def test_the_parts_of_the_latency_add_up_to_the_age_of_the_newest_exposure(tmp_path):
    """The frames were taken 1 s before they were published, and every part is a time that passed."""
    with serving(config(tmp_path)) as (server, client):
        poses: list[RobotPose] = []
        client.robot("a").on_pose(poses.append)
        begin_ns = time.time_ns()
        send(server, live(ARENA.messages(30), ago_ns=10**9))
        wait_for(lambda: client.status(DEADLINE_S).next().robots.get("a") == "tracked")
        elapsed_ms = (time.time_ns() - begin_ns) * 1e-6
    with_frames = [pose.latency for pose in poses if pose.latency is not None]
    assert with_frames
    for latency in with_frames:
        parts = latency.camera_ms, latency.network_ms, latency.wait_ms, latency.fuse_ms
        assert min(parts) >= 0
        assert sum(parts) == pytest.approx(latency.total_ms, abs=1e-6)
        assert latency.exposure_ms + latency.detect_ms <= latency.total_ms
        assert 0 < latency.total_ms < 1000 + elapsed_ms


def test_invalid_detections_are_counted_and_skipped(tmp_path):
    good = live(ARENA.messages(1))
    old = msgspec.structs.replace(good[0], t_ns=1)
    unknown = msgspec.structs.replace(good[0], camera="other")
    small = msgspec.structs.replace(good[1], width=64)
    with serving(config(tmp_path)) as (server, client):
        status = client.status(DEADLINE_S)
        for data in (b"", b"\x00\xff" * 50, encode(good[0])[:40], encode(unknown)):
            server.session.put(KEYS.detections("cam0"), data)
        send(server, [old, unknown, small])
        expected = {
            "undecodable detections": 4,
            "implausible time": 1,
            "unknown camera": 1,
            "wrong image size": 1,
        }
        wait_for(lambda: status.next().faults == expected)


def test_a_frame_set_without_a_solution_costs_the_tracks_but_not_the_server(tmp_path):
    frames = ARENA.messages(12)
    with serving(config(tmp_path)) as (server, client):
        statuses, fault = Inbox(), "frame set without a solution"
        client.status().on_message(statuses.put)

        def is_counted() -> bool:
            send(server, later(frames))
            return statuses.until(lambda items: items and fault in items[-1].faults, ATTEMPT_S)

        send_until_tracked(server, client, frames)
        tracker = server.pipeline.tracker
        assert tracker is not None
        server.transport.enqueue(lambda: tracker.table.states.P.fill(np.nan))
        wait_for(is_counted)
        send_until_tracked(server, client, frames)
        assert max(status.faults.get(fault, 0) for status in statuses.items) == 1


def send_in_real_time(server: Server, n_frames: int) -> list[int]:
    """Publish frames of all cameras about thirty times a second, each with the present time; these times in ns."""
    pause, stamps_ns = threading.Event(), list[int]()
    for k in range(n_frames):
        t_ns = time.time_ns()
        stamps_ns.append(t_ns)
        send(
            server,
            [msgspec.structs.replace(m, seq=k, t_ns=t_ns, sent_ns=t_ns) for m in ARENA.messages(1)],
        )
        pause.wait(1 / 30)
    return stamps_ns


@pytest.mark.parametrize(
    ("max_lag_ns", "drops"), [pytest.param(60 * 10**9, False, marks=pytest.mark.ci), (0, True)]
)
def test_queued_frames_are_late_only_if_the_server_lags_far_behind(tmp_path, monkeypatch, max_lag_ns, drops):
    """Frames arrive on time while the server is busy with something else."""
    monkeypatch.setattr("fusion.server.server.MAX_LAG_NS", max_lag_ns)
    settings = msgspec.structs.replace(config(tmp_path), limits=Limits(lateness_ms=50))
    with Server(settings) as server, connected(server) as client:
        poses: list[RobotPose] = []
        statuses: list[FusionStatus] = []
        client.robot("a").on_pose(poses.append)
        client.status().on_message(statuses.append)  # subscribed before the server runs, to miss none
        send_in_real_time(server, 30)
        done = threading.Event()
        server.transport.enqueue(done.set)  # after all frames
        with running_server(server):
            assert done.wait(DEADLINE_S)
            wait_for(
                lambda: (
                    client.status(DEADLINE_S).next()
                    and any(s.frame_sets_per_s > 0 or TOO_SLOW in s.faults for s in statuses)
                )
            )
            assert any(status.faults.get(TOO_SLOW, 0) for status in statuses) == drops
            assert drops or any(pose.state == "tracked" for pose in poses)


def test_frame_sets_without_frames_are_skipped_after_a_pause(tmp_path, monkeypatch):
    """A server that was busy tracked each of them first; on a loaded machine the frames behind them became too old in
    that time, and so did the next ones: robots were lost for 20 s."""
    monkeypatch.setattr("fusion.server.server.MAX_LAG_NS", 60 * 10**9)
    settings = msgspec.structs.replace(config(tmp_path), limits=Limits(lateness_ms=50))
    with Server(settings) as server, connected(server) as client:
        fused = Inbox()
        subscriber = client.session.declare_subscriber(
            frames_key("test"), lambda sample: fused.put(decode(sample.payload.to_bytes(), FusedFrames))
        )
        *_, begin_ns = send_in_real_time(server, 20)
        threading.Event().wait(1.5)
        end_ns, *_ = send_in_real_time(server, 20)
        with running_server(server):
            assert fused.until(lambda sets: sum(bool(s.cameras) for s in sets) > 30, DEADLINE_S)
        subscriber.undeclare()
    assert sum(begin_ns < s.t_ns < end_ns and not s.cameras for s in fused.items) <= 2  # of 30


def test_the_clock_is_answered(tmp_path):
    with serving(config(tmp_path)) as (_, client):
        replies = client.session.get(KEYS.clock, timeout=DEADLINE_S)
        data = next(reply.ok.payload.to_bytes() for reply in replies if reply.ok is not None)
        t_ns = decode(data, ClockReply).t_ns
        assert abs(t_ns - time.time_ns()) < 5e9


def test_a_taken_port_is_reported(tmp_path):
    settings = config(tmp_path)
    with serving(settings) as (server, _):
        taken = msgspec.structs.replace(settings, listen=server.endpoints)
        with pytest.raises(NetworkError, match="can't listen on"), Server(taken):
            pass


def test_a_server_on_port_0_writes_the_endpoint_that_clients_reach(tmp_path):
    """`python -m fusion --listen tcp/127.0.0.1:0 --endpoints-file PATH`."""
    settings, path = config(tmp_path), tmp_path / "endpoints"
    assert settings.rig is not None
    files = ["--rig", settings.rig, "--robots", settings.robots, "--endpoints-file", path]
    with running("fusion", "--arena", "test", "--listen", "tcp/127.0.0.1:0", *files):
        wait_for(path.exists)
        (endpoint,) = path.read_text().splitlines()
        with Client.connect(endpoint, arena="test") as client:
            rig = client.rig(DEADLINE_S)
            assert rig is not None
            assert rig.cameras == ARENA.cameras


def test_an_unknown_zone_is_refused_with_the_known_ones(tmp_path):
    zones = zones_of({"west": ("cam0",), "east": ("cam1",)}, "tcp/hall:7447")
    settings = override(config(tmp_path), zones=zones)
    with pytest.raises(ConfigError, match=r"no zone 'wset'; did you mean west\? the zones are west, east"):
        in_zone(settings, "wset")
    with pytest.raises(ConfigError, match="give --zone, one of west, east"):
        in_zone(settings, None)
    with pytest.raises(ConfigError, match=r"arena\.yaml has no zones"):
        in_zone(config(tmp_path), "west")
    assert in_zone(settings, "east").listen == ("tcp/0.0.0.0:7447",)


@pytest.mark.parametrize(
    ("zones", "fault"),
    [
        ({"a": ("cam0",), "b": ("cam0",)}, "'cam0' is there twice"),
        ({"a/b": ("cam0",)}, "can't name a zone"),
        ({"cam0": ("cam0",)}, "'cam0' is there twice"),
    ],
)
def test_zones_have_names_and_cameras_of_their_own(tmp_path, zones: dict, fault: str):
    with pytest.raises(ConfigError, match=fault):
        override(config(tmp_path), zones=zones_of(zones, "tcp/hall:7447"))


def test_a_client_waits_no_longer_than_its_timeout(tmp_path):
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


def test_each_pose_is_published_once_with_others_and_once_on_its_robots_key(tmp_path):
    """A subscriber of all keys receives the second only."""
    together, alone = Inbox(), Inbox()
    with serving(config(tmp_path)) as (server, client):
        subscribers = [
            client.session.declare_subscriber(
                KEYS.poses, lambda sample: together.put(sample.payload.to_bytes())
            ),
            client.session.declare_subscriber(
                "test/**", lambda s: alone.put((str(s.key_expr), s.payload.to_bytes()))
            ),
        ]
        wait_for(lambda: client.status(DEADLINE_S).next())
        send(server, live(ARENA.messages(12)))
        wait_for(lambda: client.robot("a", DEADLINE_S).next().state == "tracked")
        wait_for(lambda: client.status(DEADLINE_S).next())
        for subscriber in subscribers:
            subscriber.undeclare()
    single = Counter(data for key, data in alone.items if key == KEYS.robot_pose("a"))
    joined = Counter(encode(pose) for data in together.items for pose in decode(data, RobotPoses).poses)
    assert joined == single
    assert set(single.values()) == {1}
    assert all("@" not in key for key, _ in alone.items)


def test_undecodable_poses_are_counted(tmp_path):
    with serving(config(tmp_path)) as (server, client):
        server.session.put(KEYS.poses, b"nonsense")
        status = client.status(DEADLINE_S)
        wait_for(lambda: status.next() and client.faults["RobotPoses"] == 1)


def test_the_process_of_the_server_has_no_threads_for_linear_algebra():
    """Before: one for each core, which wait for each other; on a busy machine a frame set took 14 ms instead of 2."""
    code = (
        "import fusion.__main__, os, numpy, scipy.linalg\n"
        "numpy.ones((500, 500)) @ numpy.ones((500, 500))\n"
        "print(len(os.listdir('/proc/self/task')))"
    )
    environment = {k: v for k, v in os.environ.items() if not k.endswith("_NUM_THREADS")}
    done = subprocess.run(
        [sys.executable, "-c", code],
        cwd=ROOT,
        env=environment,
        capture_output=True,
        text=True,
        check=True,
        timeout=DEADLINE_S,
    )
    assert done.stdout == "1\n"
