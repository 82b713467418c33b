# SPDX-License-Identifier: BSD-3-Clause
"""A replay repeats the poses and the markers of the live server byte for byte, on a network with every fault."""

import subprocess
import threading
import time
from pathlib import Path

import msgspec
import numpy as np
import pytest

from calib.rig.recording import read_messages
from camera_node.protocol.messages import Detections, decode, encode
from camera_node.protocol.session import open_client
from fusion.commands.replay import replay
from fusion.protocol.pose_messages import FusedFrames, RobotPose
from tests.fusion.arena_process import ARENA, saving
from tests.fusion.serving import KEYS, ServerProcess
from tests.processes import running
from tests.waiting import wait_for

FRAMES = 120  # of each camera: 4 s
LOST, LATE, VERY_LATE = 0.05, 0.1, 0.02  # shares of frames; the last ones miss the server's limit of 150 ms
OUTAGE_S = 1.5, 2.3  # of one camera


def schedule(messages: list[Detections], rng: np.random.Generator) -> list[tuple[float, Detections]]:
    """When each message is sent, seconds after the first capture; lost ones are left out."""
    sent = []
    for message in messages:
        t = (message.t_ns - messages[0].t_ns) * 1e-9
        is_out = message.camera == "cam2" and OUTAGE_S[0] < t < OUTAGE_S[1]
        if rng.random() > LOST and not is_out:
            late_s, very_late_s = rng.uniform(0.03, 0.14), 0.5
            chance = rng.random()
            sent.append(
                (t + (very_late_s if chance < VERY_LATE else late_s if chance < LATE else 0.005), message)
            )
    return sorted(sent, key=lambda entry: entry[0])


def publish(endpoint: str) -> None:
    """Publish what the cameras see, in real time, over a bad network."""
    pause, begun_ns = threading.Event(), time.time_ns()
    messages = sorted(ARENA.messages(FRAMES), key=lambda message: message.t_ns)
    with open_client([endpoint]) as session:
        wait_for(lambda: session.info.routers_zid())
        pause.wait(0.5)  # until routes are known
        begun_ns = time.time_ns()
        for at_s, message in schedule(messages, np.random.default_rng(7)):
            pause.wait(max(0.0, at_s - 1e-9 * (time.time_ns() - begun_ns)))
            t_ns = message.t_ns - messages[0].t_ns + begun_ns
            session.put(
                KEYS.detections(message.camera),
                encode(msgspec.structs.replace(message, t_ns=t_ns, sent_ns=t_ns)),
            )
        pause.wait(1.0)


def content(path: Path, since_ns: int, until_ns: int) -> tuple[dict, dict]:
    """The poses by robot and time, without their latency, which only exists live; and the markers by time."""
    poses, markers = {}, {}
    for key, data, _ in read_messages(path):
        if key.endswith("/pose"):
            pose = msgspec.structs.replace(decode(data, RobotPose), latency=None)
            poses[pose.robot, pose.t_ns] = encode(pose)
        elif key.endswith("/markers"):
            markers[msgspec.msgpack.decode(data)["t_ns"]] = data
    return (
        {key: data for key, data in poses.items() if since_ns <= key[1] <= until_ns},
        {t_ns: data for t_ns, data in markers.items() if since_ns <= t_ns <= until_ns},
    )


@pytest.mark.ci
def test_a_replay_equals_the_live_server(tmp_path: Path):
    """From the first complete frame set on, although frames were lost, late and too late, and a camera was away."""
    path = tmp_path / "live.mcap"
    with ServerProcess(saving(tmp_path)) as server:
        words = ("record", path, "--connect", server.endpoint, "--arena", "test")
        with running("fusion", *words, stdout=subprocess.DEVNULL):
            wait_for(path.exists)
            publish(server.endpoint)
    assert replay(path, out=tmp_path / "again.mcap") == 0
    sets = [
        decode(data, FusedFrames).t_ns
        for key, data, _ in read_messages(path)
        if key.endswith("/fusion/frames")
    ]
    assert len(sets) > FRAMES / 2
    live, again = (content(tmp_path / name, sets[0], sets[-1]) for name in ("live.mcap", "again.mcap"))
    assert len(live[0]) > FRAMES / 2
    assert live == again
