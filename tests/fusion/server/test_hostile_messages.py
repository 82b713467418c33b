# SPDX-License-Identifier: BSD-3-Clause
"""MessagePack that costs much to decode, or is of other types, ends neither the server's nor a recorder's process.

`python -m tests.benchmarks.fuzz` sends a million mutated messages to all programs; these are the worst ones by hand.
"""

import signal
import struct
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import msgspec
import psutil
import pytest
import zenoh

from calib.rig.rig_messages import rig_step_key, set_rig_key
from camera_node.protocol.messages import encode
from camera_node.protocol.session import open_client
from fusion.client.arena import Arena as Client
from fusion.protocol.pose_messages import robots_key, set_robots_key
from tests.conftest import ROOT
from tests.fusion.serving import ARENA, KEYS, config, live, serving_process
from tests.processes import killed_at_end
from tests.waiting import DEADLINE_S, wait_for

DETECTIONS = msgspec.msgpack.decode(encode(live(ARENA.messages(1))[0]))
MAX_GROWTH_MB = 250.0  # of a process: what the queues of a few keys hold of the largest messages
QUERIES = (
    set_rig_key("test"),
    rig_step_key("test", "undo"),
    rig_step_key("test", "redo"),
    robots_key("test"),
    set_robots_key("test"),
    KEYS.clock,
    KEYS.rig,
)
KEYS_OF_MESSAGES = (
    KEYS.detections("cam0"),
    KEYS.detections("other"),
    KEYS.camera_status("cam0"),
    KEYS.robot_pose("a"),
    KEYS.poses,
    KEYS.markers,
    KEYS.fusion_status,
    KEYS.rig,
)


def payloads() -> Iterator[bytes]:
    """Lengths without content, deep nesting, wrong types, huge maps and lists, and numbers at their limits."""
    for head in (b"\xdd", b"\xdf", b"\xc6", b"\xdb"):  # list, map, bytes and text of 4 G entries
        yield head + b"\xff\xff\xff\xff"
        yield b"\x81\xa2uv" + head + b"\xff\xff\xff\xf0"
    yield b"\x91" * 200_000 + b"\xc0"
    yield b"\x81\xa1x" * 100_000 + b"\xc0"
    yield b"\xdd" + struct.pack(">I", 900_000) + b"\xc0" * 900_000
    yield msgspec.msgpack.encode({**DETECTIONS, "unknown": [[]] * 300_000})
    yield msgspec.msgpack.encode({f"name{k}": k for k in range(60_000)})
    yield msgspec.msgpack.encode({"version": 1, "rig": {"cameras": {f"c{k}": {} for k in range(60_000)}}})
    yield msgspec.msgpack.encode(
        {"version": 1, "define": {f"r{k}": {"diameter_m": 0.1} for k in range(40_000)}}
    )
    for value in (None, True, "x" * 100_000, [1] * 1000, {"a": {}}, 2**64 - 1, -(2**63), 1e308, float("nan")):
        for name in ("version", "t_ns", "camera", "uv", "width"):
            yield msgspec.msgpack.encode({**DETECTIONS, name: value})


@contextmanager
def recording(endpoint: str, out: Path) -> Iterator[subprocess.Popen]:
    """`fusion record` in a process of its own."""
    words = ["record", str(out), "--connect", endpoint, "--arena", "test"]
    with killed_at_end([sys.executable, "-m", "fusion", *words], cwd=ROOT) as process:
        wait_for(out.exists)
        yield process


def attack(session: zenoh.Session) -> None:
    """Every payload on every key, and as every request; waits for the answer of the last request."""
    for payload in payloads():
        for key in KEYS_OF_MESSAGES:
            session.put(key, payload, congestion_control=zenoh.CongestionControl.BLOCK)
        for key in QUERIES:
            session.get(key, payload=payload, timeout=DEADLINE_S)  # the replies are dropped


@pytest.mark.slow
def test_server_and_recorder_survive_hostile_messages(tmp_path: Path):
    out = tmp_path / "out.mcap"
    with serving_process(config(tmp_path)) as (endpoint, server), recording(endpoint, out) as recorder:
        with open_client([endpoint]) as session, Client.connect(endpoint, arena="test") as client:
            assert client.rig(DEADLINE_S) is not None
            meters = [psutil.Process(process.pid) for process in (server, recorder)]
            before = [meter.memory_info().rss for meter in meters]
            attack(session)
            wait_for(lambda: client.status(DEADLINE_S).next().faults.get("undecodable detections"))
            rig = wait_for(lambda: client.rig(1.0))
            growth_mb = [(m.memory_info().rss - b) * 1e-6 for m, b in zip(meters, before, strict=True)]
        assert rig is not None
        assert rig.cameras == ARENA.cameras
        assert max(growth_mb) < MAX_GROWTH_MB
        assert server.poll() is None
        assert recorder.poll() is None
        recorder.send_signal(signal.SIGTERM)
        assert recorder.wait(DEADLINE_S) == 0
