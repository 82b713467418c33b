# SPDX-License-Identifier: BSD-3-Clause
"""A synthetic arena in real time: the settings of its server, and what its cameras send."""

import contextlib
import math
import threading
import time
from collections.abc import Callable, Iterator
from itertools import count
from pathlib import Path

import msgspec

from camera_node.protocol.messages import Detections, encode
from camera_node.protocol.session import open_client
from fusion.server.arena_config import ArenaConfig
from tests.fusion.serving import KEYS, REAL_TIME_MS, config
from tests.fusion.synthetic import PERIOD_NS, TRIANGLE, WIDE, Arena, circle
from tests.waiting import in_thread

LOOP_S = 8.0  # of the motions, which repeat
ARENA = Arena(
    {"a": TRIANGLE, "b": WIDE}, {"a": circle(LOOP_S, 0.8), "b": circle(-LOOP_S, 1.3, 0.4)}, sigma_px=0.1
)


def saving(folder: Path) -> ArenaConfig:
    """The settings of a server that saves changes of its rig and robots, and whose cameras send in real time."""
    saved = {"saved_rig": str(folder / "saved.yaml"), "saved_robots": str(folder / "robots.saved.yaml")}
    return msgspec.structs.replace(config(folder, lateness_ms=REAL_TIME_MS), **saved)


def in_real_time(
    messages: list[Detections], period_s: float, stop: threading.Event, max_age_s: float = math.inf
) -> Iterator[Detections]:
    """Messages of `period_s` again and again, each stamped with the time at which it is yielded, until `stop` is set.

    Those that are older than `max_age_s` are left out: a camera on a machine that is too slow drops frames.
    """
    begun_ns, n = time.time_ns(), max(message.seq for message in messages) + 1
    for repetition in count():
        for message in messages:
            t_ns = begun_ns + round(repetition * period_s * 1e9) + message.t_ns - messages[0].t_ns
            if stop.wait(max(0.0, 1e-9 * (t_ns - time.time_ns()))):
                return
            if 1e-9 * (time.time_ns() - t_ns) <= max_age_s:
                seq = message.seq + repetition * n
                yield msgspec.structs.replace(message, seq=seq, t_ns=t_ns, sent_ns=t_ns)


@contextlib.contextmanager
def cameras_at(
    endpoint: str, altered: Callable[[Detections], Detections] = lambda message: message
) -> Iterator[None]:
    """Publish what the cameras see, in real time, each message as `altered` makes it."""
    messages = sorted(ARENA.messages(round(LOOP_S * 1e9 / PERIOD_NS)), key=lambda message: message.t_ns)
    stop = threading.Event()

    def publish() -> None:
        with open_client([endpoint]) as session:
            for message in in_real_time(messages, LOOP_S, stop):
                session.put(KEYS.detections(message.camera), encode(altered(message)))

    with in_thread(publish, stop.set):
        yield
