# SPDX-License-Identifier: BSD-3-Clause
"""A server process of a synthetic arena, and what its cameras see in real time."""

import contextlib
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
from tests.conftest import ROOT
from tests.fusion.serving import KEYS
from tests.fusion.synthetic import PERIOD_NS, TRIANGLE, WIDE, Arena, circle
from tests.waiting import DEADLINE_S, wait_for

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
