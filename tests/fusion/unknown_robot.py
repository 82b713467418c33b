# SPDX-License-Identifier: BSD-3-Clause
"""A server that tracks robot a, while its cameras also see another one. Both are programs, as in an arena: in the
process of a test, its page and its browser's driver would delay the frames."""

import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import count
from pathlib import Path

import msgspec

from camera_node.protocol.messages import encode
from camera_node.protocol.session import open_client
from fusion.client.arena import Arena as Client
from fusion.model.limits import Limits
from tests.conftest import ROOT
from tests.fusion.serving import ARENA, DEADLINE_S, KEYS, config, serving_process
from tests.fusion.synthetic import WIDE, Arena, line
from tests.processes import killed_at_end
from tests.waiting import wait_for

MAX_AGE_NS = 100_000_000  # of a frame that is still sent
WIDE_MOTION = line((-0.4, 0.2, 0.3), tilt=(0.05, -0.04, 0.7))  # of the robot that the server does not know


@contextmanager
def serving_an_unknown_robot(folder: Path) -> Iterator[tuple[str, Client]]:
    """The endpoint of the server, and a client that has received a tracked pose of robot a."""
    settings = msgspec.structs.replace(config(folder), limits=Limits())  # frames are sent in real time
    with serving_process(settings) as (endpoint, _):
        command = [sys.executable, "-m", "tests.fusion.unknown_robot", endpoint]
        with killed_at_end(command, cwd=ROOT), Client.connect(endpoint, arena="test") as client:
            wait_for(lambda: client.robot("a", DEADLINE_S).next().state == "tracked")
            yield endpoint, client


def publish(endpoint: str) -> None:
    """Publish what the cameras see, in real time, until this process is killed."""
    arena = Arena({**ARENA.robots, "b": WIDE}, {**ARENA.motions, "b": WIDE_MOTION}, sigma_px=0.05)
    one_second, pause = arena.messages(30), threading.Event()
    with open_client([endpoint]) as session:
        begun_ns = time.time_ns()
        for second in count():
            for message in one_second:
                t_ns = begun_ns + second * 10**9 + message.t_ns - one_second[0].t_ns
                pause.wait(max(0.0, 1e-9 * (t_ns - time.time_ns())))
                if time.time_ns() - t_ns > MAX_AGE_NS:
                    continue  # a camera on a machine that is too slow drops frames
                seq = message.seq + 30 * second
                sent = msgspec.structs.replace(message, seq=seq, t_ns=t_ns, sent_ns=t_ns)
                session.put(KEYS.detections(message.camera), encode(sent))


if __name__ == "__main__":
    publish(sys.argv[1])
