# SPDX-License-Identifier: BSD-3-Clause
"""Recordings: an arena's messages in MCAP, as they came, one channel a key; each holds what a replay needs.

Messages are in MessagePack as on the wire, under their Zenoh keys; `log_time` is when one arrived, in the recorder's
clock. The rig in force and the robots are asked of the server at the start.
"""

import contextlib
import logging
import queue
import time
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro
import zenoh

from calib.rig.messages import RigMessage
from calib.rig.recording import RecordingWriter, read_messages
from calib.rig.rig import Rig
from camera_node.errors import ConfigError
from camera_node.protocol.messages import Detections, Keys, MessageError, decode
from camera_node.protocol.session import open_client
from fusion.model.robots import Robot
from fusion.protocol.messages import RobotPose, Robots, robots_key

log = logging.getLogger("fusion.recording")
QUEUE = 20_000
ASK_S = 1.0  # for the server to tell of its rig and robots; they are asked for again while they are not there


@dataclass
class ArenaRecording:
    """What a recording holds: detections and when they arrived (ns), poses as they were told, rig and robots."""

    detections: list[tuple[int, Detections]] = field(default_factory=list)
    poses: list[RobotPose] = field(default_factory=list)
    rig: Rig | None = None  # the first that was in force
    robots: dict[str, Robot] = field(default_factory=dict)
    faults: Counter[str] = field(default_factory=Counter)

    def take(self, key: str, data: bytes, received_ns: int) -> None:
        """A recorded message; what is none is counted."""
        try:
            if key.endswith("/detections"):
                self.detections.append((received_ns, decode(data, Detections)))
            elif key.endswith("/pose"):
                self.poses.append(decode(data, RobotPose))
            elif key.endswith("/rig") and self.rig is None:
                self.rig = decode(data, RigMessage).rig()
            elif key.endswith("/robots"):
                self.robots = decode(data, Robots).robots
        except MessageError:
            self.faults[f"messages on {key} that are none"] += 1


def read_recording(path: Path) -> ArenaRecording:
    """Read a recording; of one that was cut off, what was written.

    Raises:
        ConfigError: the file is missing, or no recording of an arena.
    """
    recording = ArenaRecording()
    for key, data, received_ns in read_messages(path, recording.faults):
        recording.take(key, data, received_ns)
    if not recording.detections:
        raise ConfigError(f"{path} holds no detections; record with python -m fusion record {path}")
    return recording


def record(
    out: Path,
    /,
    *,
    connect: tuple[str, ...] = ("tcp/127.0.0.1:7447",),
    arena: str = "arena",
    zenoh_config: Annotated[Path | None, tyro.conf.arg(name="zenoh")] = None,
    seconds: float | None = None,
) -> int:
    """Record an arena's detections, poses, markers, rig and robots, until stopped.

    Args:
        out: the MCAP file to write.
        connect: the server's Zenoh endpoints.
        arena: the arena's name.
        zenoh_config: a Zenoh configuration (JSON5) for TLS, access control or scouting.
        seconds: how long; until Ctrl-C unless given.
    """
    arrived: queue.Queue[tuple[str, bytes, int]] = queue.Queue(QUEUE)
    with contextlib.ExitStack() as stack:
        writer = stack.enter_context(RecordingWriter(out))
        session = stack.enter_context(open_client(connect, zenoh_config))
        subscriber = session.declare_subscriber(f"{arena}/**", lambda sample: _enqueue(arrived, sample))
        stack.callback(subscriber.undeclare)
        with contextlib.suppress(KeyboardInterrupt):
            _write(session, arena, arrived, writer, seconds)
    for key, count in sorted(writer.counts.items()):
        print(f"{count:7} on {key}")
    print(f"wrote {out}")
    return 0


def _enqueue(arrived: queue.Queue[tuple[str, bytes, int]], sample: zenoh.Sample) -> None:
    with contextlib.suppress(queue.Full):
        arrived.put_nowait((str(sample.key_expr), sample.payload.to_bytes(), time.time_ns()))


def _write(
    session: zenoh.Session, arena: str, arrived: queue.Queue, writer: RecordingWriter, seconds: float | None
) -> None:
    end = time.monotonic() + (seconds if seconds is not None else float("inf"))
    wanted, asked = {Keys(arena).rig, robots_key(arena)}, 0.0
    while time.monotonic() < end:
        if wanted and time.monotonic() - asked > ASK_S:
            asked = time.monotonic()
            for key in wanted - writer.counts.keys():
                _ask(session, key, arrived)
            wanted -= writer.counts.keys()
        with contextlib.suppress(queue.Empty):
            writer.put(*arrived.get(timeout=0.1))


def _ask(session: zenoh.Session, key: str, arrived: queue.Queue) -> None:
    """Have the server's answer recorded as if it were published."""

    def take(reply: zenoh.Reply) -> None:
        if reply.ok is not None:
            _enqueue(arrived, reply.ok)

    session.get(key, take, timeout=ASK_S)
