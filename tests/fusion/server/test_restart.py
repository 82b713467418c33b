# SPDX-License-Identifier: BSD-3-Clause
"""A server that is killed and started again goes on with the saved rig and robots; nodes and clients reconnect."""

import contextlib
import math
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from itertools import count
from pathlib import Path

import msgspec

from calib.rig.rig import Rig, save_rig
from camera_node.protocol.messages import encode
from camera_node.protocol.session import open_client
from fusion.client.arena import Arena as Client
from tests.conftest import ROOT
from tests.fusion.serving import KEYS
from tests.fusion.synthetic import PERIOD_NS, TRIANGLE, WIDE, Arena, circle
from tests.waiting import DEADLINE_S, Inbox, wait_for

RETURN_S = 1.0  # after the server listens again, until all poses are back
LOOP_S = 8.0  # of the motions, which repeat
ARENA = Arena(
    {"a": TRIANGLE, "b": WIDE}, {"a": circle(LOOP_S, 0.8), "b": circle(-LOOP_S, 1.3, 0.4)}, sigma_px=0.1
)


class ServerProcess:
    """`python -m fusion` in a folder, killed and started again on the same port."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        save_rig(Rig(cameras=ARENA.cameras), folder / "rig.yaml")
        robots = {"robots": {"a": msgspec.to_builtins(TRIANGLE)}}
        (folder / "robots.yaml").write_bytes(msgspec.yaml.encode(robots))
        self.start("tcp/127.0.0.1:0")

    def start(self, listen: str) -> None:
        """Start the server and wait until it listens."""
        settings = {
            "arena": "test",
            "listen": [listen],
            "rig": "rig.yaml",
            "robots": "robots.yaml",
            "saved_rig": "saved.yaml",
            "saved_robots": "robots.saved.yaml",
        }
        (self._folder / "arena.yaml").write_bytes(msgspec.yaml.encode(settings))
        endpoints = self._folder / "endpoints"
        endpoints.unlink(missing_ok=True)
        words = ["--config", str(self._folder / "arena.yaml"), "--endpoints-file", str(endpoints)]
        self.process = subprocess.Popen([sys.executable, "-m", "fusion", *words], cwd=ROOT)
        wait_for(lambda: endpoints.exists() or self.process.poll() is not None)
        (self.endpoint,) = endpoints.read_text().split()

    def kill(self) -> None:
        """End the server by SIGKILL."""
        self.process.kill()
        self.process.wait()


@contextlib.contextmanager
def cameras_at(endpoint: str) -> Iterator[None]:
    """Publish what the cameras see, in real time."""
    messages = sorted(ARENA.messages(round(LOOP_S * 1e9 / PERIOD_NS)), key=lambda message: message.t_ns)
    stop = threading.Event()

    def publish() -> None:
        with open_client([endpoint]) as session:
            for start_ns in count(time.time_ns(), round(LOOP_S * 1e9)):
                for message in messages:
                    t_ns = start_ns + message.t_ns - messages[0].t_ns
                    if stop.wait(max(0.0, 1e-9 * (t_ns - time.time_ns()))):
                        return
                    stamped = msgspec.structs.replace(message, t_ns=t_ns, sent_ns=t_ns)
                    session.put(KEYS.detections(message.camera), encode(stamped))

    thread = threading.Thread(target=publish)
    thread.start()
    try:
        yield
    finally:
        stop.set()
        thread.join(DEADLINE_S)


def test_poses_return_after_the_server_was_killed(tmp_path: Path):
    """Robot b was defined over the network, so only the saved robots have it."""
    server = ServerProcess(tmp_path)
    try:
        with Client.connect(server.endpoint, arena="test") as client, cameras_at(server.endpoint):
            poses = Inbox()
            client.poses().on_message(lambda pose: poses.put((time.monotonic(), pose)))

            def tracked_between(begin_s: float, end_s: float = math.inf) -> set[str]:
                return {p.robot for t, p in poses.items if begin_s < t <= end_s and p.state == "tracked"}

            client.change_robots(define={"b": WIDE})
            assert poses.until(lambda _: tracked_between(0.0) == {"a", "b"})
            server.kill()
            began_s = time.monotonic()
            server.start(server.endpoint)
            listens_s = time.monotonic()
            assert poses.until(lambda _: tracked_between(began_s) == {"a", "b"})
            first_s = min(t for t, _ in poses.items if tracked_between(began_s, t) == {"a", "b"})
            assert first_s - listens_s < RETURN_S
    finally:
        server.kill()
