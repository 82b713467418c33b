# SPDX-License-Identifier: BSD-3-Clause
"""A program of a user: follows all poses, markers and the status of an arena through `fusion.client.Arena`.

It prints when it has a tracked pose, ten times a second at most, by the monotonic clock of the machine.
"""

import contextlib
import signal
import time

import tyro

from camera_node.foundation.errors import NetworkError
from camera_node.foundation.program import run
from camera_node.foundation.terminal import say
from fusion.client.arena import Arena

PERIOD_S = 0.1


def main(connect: str, arena: str) -> None:
    """Follow until SIGTERM; a server that is away is waited for."""
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    with contextlib.suppress(KeyboardInterrupt), Arena.connect(connect, arena=arena) as client:
        client.markers()
        client.status()
        said_s = 0.0
        while True:
            with contextlib.suppress(NetworkError):
                for pose in client.poses(1.0):
                    assert len(pose.position) == 3
                    if pose.state == "tracked" and time.monotonic() - said_s > PERIOD_S:
                        said_s = time.monotonic()
                        say(f"{said_s:.3f}")


if __name__ == "__main__":
    run(lambda: tyro.cli(main))
