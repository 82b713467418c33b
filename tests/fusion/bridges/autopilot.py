# SPDX-License-Identifier: BSD-3-Clause
"""pymavlink at an autopilot's end of the connection."""

import time

from pymavlink import mavutil

from tests.conftest import free_port
from tests.waiting import DEADLINE_S


class Autopilot:
    """pymavlink's end of the connection; its own clock starts at 0, as that of PX4."""

    def __init__(self) -> None:
        self.port = free_port()
        self.link = mavutil.mavlink_connection(f"udpin:127.0.0.1:{self.port}", dialect="common")
        self.begun_ns = time.monotonic_ns()

    def __enter__(self) -> "Autopilot":
        return self

    def __exit__(self, *exception: object) -> None:
        self.link.close()

    def receive(self, kind: str):
        message = self.link.recv_match(type=kind, blocking=True, timeout=DEADLINE_S)
        assert message is not None, f"no {kind}"
        return message
