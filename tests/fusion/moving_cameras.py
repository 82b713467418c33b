# SPDX-License-Identifier: BSD-3-Clause
"""A program that publishes, in real time, what the cameras of an arena see of a robot on a circle.

    python -m tests.fusion.moving_cameras ENDPOINT

It stamps as a camera node does: the driver's time is monotonic, becomes Unix time, and then the server's.
"""

import sys
import threading
import time

import numpy as np

from camera_node.clocks.host_clock import unix_ahead_ns
from camera_node.node.clock_sync import ClockSync
from camera_node.protocol.messages import Detections, Keys, encode
from camera_node.protocol.session import open_client
from tests.fusion.synthetic import PERIOD_NS, TRIANGLE, Arena, circle

KEYS = Keys("test")
SPEED_M_S, RADIUS_M = 0.94, 0.6
MOVING = Arena({"a": TRIANGLE}, {"a": circle(2 * np.pi * RADIUS_M / SPEED_M_S, RADIUS_M)}, sigma_px=0.05)


def publish(endpoint: str) -> None:
    """Publish until the process is terminated; the robot's motion is a function of the monotonic clock.

    Frames for which a busy machine has no time are left out, as a camera leaves them out.
    """
    session, rng, pause = open_client([endpoint]), np.random.default_rng(1), threading.Event()
    clock = ClockSync(session, KEYS).start()
    while clock.estimate() is None:
        pause.wait(0.01)
    first = index = time.monotonic_ns() // PERIOD_NS
    while True:
        index = max(index + 1, time.monotonic_ns() // PERIOD_NS)
        for name, phase in sorted(zip(MOVING.cameras, MOVING.phases, strict=True), key=lambda at: at[1]):
            monotonic_ns = round((index + phase) * PERIOD_NS)
            pause.wait(max(0.0, (monotonic_ns - time.monotonic_ns()) * 1e-9))
            roundels = MOVING.detect(name, monotonic_ns * 1e-9, rng)
            header = {"t_ns": clock.to_server(monotonic_ns + unix_ahead_ns()), "sent_ns": clock.now_ns()}
            lens = MOVING.cameras[name]
            size = {"width": lens.width, "height": lens.height}
            message = Detections.pack(roundels, camera=name, seq=index - first, **header, **size)
            session.put(KEYS.detections(name), encode(message))


if __name__ == "__main__":
    publish(sys.argv[1])
