# SPDX-License-Identifier: BSD-3-Clause
"""A server that tracks robot a, while its cameras also see another one. Both are programs, as in an arena: in the
process of a test, its page and its browser's driver would delay the frames."""

import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import msgspec

from camera_node.protocol.messages import encode
from camera_node.protocol.session import open_client
from fusion.client.arena import Arena as Client
from tests.conftest import ROOT
from tests.fusion.arena_process import in_real_time
from tests.fusion.serving import ARENA, KEYS, REAL_TIME_MS, config, serving_process
from tests.fusion.synthetic import WIDE, Arena, line
from tests.processes import killed_at_end
from tests.waiting import DEADLINE_S, wait_for

MAX_AGE_S = 0.1  # of a frame that is still sent
EVERY = 3  # frame of 30 Hz is sent: the robots stand still, and a browser needs the processor
WIDE_MOTION = line((-0.4, 0.2, 0.3), tilt=(0.05, -0.04, 0.7))  # of the robot that the server does not know


@contextmanager
def serving_an_unknown_robot(folder: Path) -> Iterator[tuple[str, Client]]:
    """The endpoint of the server, and a client that has received a tracked pose of robot a."""
    with serving_process(config(folder, lateness_ms=REAL_TIME_MS)) as (endpoint, _):
        command = [sys.executable, "-m", "tests.fusion.unknown_robot", endpoint]
        with killed_at_end(command, cwd=ROOT), Client.connect(endpoint, arena="test") as client:
            wait_for(lambda: client.robot("a", DEADLINE_S).next().state == "tracked")
            yield endpoint, client


def publish(endpoint: str) -> None:
    """Publish what the cameras see, in real time, until this process is killed."""
    arena = Arena({**ARENA.robots, "b": WIDE}, {**ARENA.motions, "b": WIDE_MOTION}, sigma_px=0.05)
    messages = [
        msgspec.structs.replace(message, seq=message.seq // EVERY)
        for message in arena.messages(30)
        if message.seq % EVERY == 0
    ]
    with open_client([endpoint]) as session:
        for message in in_real_time(messages, 1.0, threading.Event(), MAX_AGE_S):
            session.put(KEYS.detections(message.camera), encode(message))


if __name__ == "__main__":
    publish(sys.argv[1])
