# SPDX-License-Identifier: BSD-3-Clause
"""Records an arena's messages in MCAP, one channel a key, and reads such recordings.

Messages are in MessagePack as on the wire, under their Zenoh keys. `log_time` is the time of arrival in the recorder's
clock. At the start the recorder requests the active rig and the robots from the server, so a recording contains
everything that a replay needs.
"""

import contextlib
import queue
import time
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path

import zenoh

from calib.rig.messages import RigMessage
from calib.rig.recording import RecordingWriter, read_messages
from calib.rig.rig import Rig
from camera_node.errors import ConfigError
from camera_node.protocol.messages import Detections, Keys, MessageError, decode
from fusion.model.robots import Robot
from fusion.protocol.messages import RobotPose, Robots, robots_key

QUEUE_SIZE = 20_000
REQUEST_S = 1.0  # the timeout of a request for the rig or the robots, and the interval until the next one


@dataclass
class ArenaRecording:
    """The content of a recording: detections and when they arrived (ns), published poses, rig and robots."""

    detections: list[tuple[int, Detections]] = field(default_factory=list)
    poses: list[RobotPose] = field(default_factory=list)
    rig: Rig | None = None  # the first one
    robots: dict[str, Robot] = field(default_factory=dict)
    faults: Counter[str] = field(default_factory=Counter)

    def add(self, key: str, data: bytes, received_ns: int) -> None:
        """Add a recorded message; count it if it can't be decoded."""
        try:
            if key.endswith("/detections"):
                self.detections.append((received_ns, decode(data, Detections)))
            elif key.endswith("/pose"):
                self.poses.append(decode(data, RobotPose))
            elif key.endswith("/rig") and self.rig is None:
                self.rig = decode(data, RigMessage).rig
            elif key.endswith("/robots"):
                self.robots = decode(data, Robots).robots
        except MessageError:
            self.faults[f"undecodable messages on {key}"] += 1


def read_recording(path: Path) -> ArenaRecording:
    """Read a recording; of a truncated one, everything before its end.

    Raises:
        ConfigError: the file is missing, or no recording of an arena.
    """
    recording = ArenaRecording()
    for key, data, received_ns in read_messages(path, recording.faults):
        recording.add(key, data, received_ns)
    if not recording.detections:
        raise ConfigError(f"{path} holds no detections; record with python -m fusion record {path}")
    return recording


def record_arena(
    session: zenoh.Session, arena: str, writer: RecordingWriter, seconds: float | None = None
) -> None:
    """Write all messages of an arena for `seconds`, or until Ctrl-C."""
    received: queue.Queue[tuple[str, bytes, int]] = queue.Queue(QUEUE_SIZE)
    subscriber = session.declare_subscriber(f"{arena}/**", lambda sample: _enqueue(received, sample))
    end = time.monotonic() + (seconds if seconds is not None else float("inf"))
    missing, requested = {Keys(arena).rig, robots_key(arena)}, 0.0
    with contextlib.suppress(KeyboardInterrupt):
        while time.monotonic() < end:
            if missing and time.monotonic() - requested > REQUEST_S:
                requested = time.monotonic()
                missing -= writer.counts.keys()
                for key in missing:
                    _request(session, key, received)
            with contextlib.suppress(queue.Empty):
                writer.put(*received.get(timeout=0.1))
    subscriber.undeclare()


def _enqueue(received: queue.Queue[tuple[str, bytes, int]], sample: zenoh.Sample) -> None:
    with contextlib.suppress(queue.Full):
        received.put_nowait((str(sample.key_expr), sample.payload.to_bytes(), time.time_ns()))


def _request(session: zenoh.Session, key: str, received: queue.Queue[tuple[str, bytes, int]]) -> None:
    """Query the server; record the reply as if it were published."""

    def take(reply: zenoh.Reply) -> None:
        if reply.ok is not None:
            _enqueue(received, reply.ok)

    session.get(key, take, timeout=REQUEST_S)
