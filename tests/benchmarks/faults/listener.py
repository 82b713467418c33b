# SPDX-License-Identifier: BSD-3-Clause
"""A program of a user: follows all poses, markers and the status of an arena through `fusion.client.Arena`."""

import contextlib
import signal

import tyro

from camera_node.errors import NetworkError
from fusion.client.arena import Arena


def main(connect: str, arena: str) -> None:
    """Follow until SIGTERM; a server that is away is waited for."""
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    with contextlib.suppress(KeyboardInterrupt), Arena.connect(connect, arena=arena) as client:
        client.markers()
        client.status()
        while True:
            with contextlib.suppress(NetworkError):
                for pose in client.poses(1.0):
                    assert len(pose.position) == 3


if __name__ == "__main__":
    tyro.cli(main)
