# SPDX-License-Identifier: BSD-3-Clause
"""Cameras that publish a synthetic arena in real time, well-behaved or not."""

import threading
import time
from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import dataclass
from itertools import cycle

import msgspec
import numpy as np

from camera_node.detection.roundels import Roundels
from camera_node.protocol.messages import MAX_ROUNDELS, Detections, Keys, encode
from camera_node.protocol.session import open_client
from fusion.client.arena import Arena as Client
from fusion.protocol.pose_messages import FusionStatus, RobotPose
from tests.fusion.serving import ARENA
from tests.waiting import Inbox, in_thread

KEYS = Keys("test")
HZ = 30.0
MOST_TRUE = 16  # roundels of the arena in one frame
Alter = Callable[[Detections], Detections]


def publishing_camera(
    endpoint: str, name: str, hz: float = HZ, alter: Alter = lambda m: m
) -> AbstractContextManager[None]:
    """A camera that publishes its frames of the arena in real time, in a thread and a session of its own."""
    messages = [m for m in ARENA.messages(4) if m.camera == name]
    stopped = threading.Event()

    def publish() -> None:
        with open_client([endpoint]) as session:
            publisher = session.declare_publisher(KEYS.detections(name))
            seq, due_s = 0, time.monotonic()
            while not stopped.wait(max(0.0, due_s - time.monotonic())):
                due_s = max(due_s + 1 / hz, time.monotonic() - 1 / hz)  # no burst after a delay
                now_ns = time.time_ns()
                message = msgspec.structs.replace(
                    messages[seq % len(messages)], seq=seq, t_ns=now_ns, sent_ns=now_ns
                )
                publisher.put(encode(alter(message)))
                seq += 1

    return in_thread(publish, stopped.set)


@dataclass
class Flood:
    """Adds false roundels at random places to every frame, as a texture or an attacker does."""

    n: int = MAX_ROUNDELS

    def __post_init__(self) -> None:
        rng = np.random.default_rng(7)
        self._columns = cycle(
            [_false_columns(self.n - MOST_TRUE, rng) for _ in range(13)]
        )  # publishing is cheap

    def __call__(self, message: Detections) -> Detections:
        false = next(self._columns)
        return msgspec.structs.replace(
            message, **{c: getattr(message, c) + false[c] for c in Detections.COLUMNS}
        )


def _false_columns(n: int, rng: np.random.Generator) -> dict[str, bytes]:
    """The columns of n roundels at random places, with random outlines."""
    uv = rng.uniform([10, 10], [790, 590], (n, 2))
    axes = np.sort(rng.uniform(10, 30, uv.shape))[:, ::-1]
    header = {"camera": "x", "seq": 0, "t_ns": 0, "width": 800, "height": 600}
    columns = msgspec.structs.asdict(Detections.pack(Roundels.from_points(uv, 0.1), **header))
    columns["axes_px"], columns["angle_rad"] = axes.astype("<f4").tobytes(), np.zeros(n, "<f4").tobytes()
    return columns


class Observer:
    """A client that measures the poses of robot a, and reads the server's status."""

    def __init__(self, endpoint: str) -> None:
        self._client = Client.connect(endpoint, arena="test")
        self._poses, self._statuses = Inbox(), Inbox()
        self._client.robot("a").on_pose(self._poses.put)
        self._client.status().on_message(self._statuses.put)

    def __enter__(self) -> "Observer":
        return self

    def __exit__(self, *exception: object) -> None:
        self._client.close()

    def collect(self, seconds: float) -> list[RobotPose]:
        """The next poses of so many seconds at `HZ`, by their own time."""
        first = len(self._poses.items)
        end_ns = time.time_ns() + round(seconds * 1e9)
        assert self._poses.until(lambda poses: len(poses) > first and poses[-1].t_ns > end_ns)
        return self._poses.items[first:]

    def status(self) -> FusionStatus:
        """The next status."""
        n = len(self._statuses.items)
        assert self._statuses.until(lambda statuses: len(statuses) > n)
        return self._statuses.items[-1]


def latency_ms(poses: list[RobotPose], percentile: float = 50.0) -> float:
    """A percentile of the latencies of poses."""
    return float(np.percentile([pose.latency.total_ms for pose in poses if pose.latency], percentile))
