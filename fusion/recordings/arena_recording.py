# SPDX-License-Identifier: BSD-3-Clause
"""Records an arena's messages in MCAP, one channel a key, and reads such recordings.

Messages are in MessagePack as on the wire, under their Zenoh keys. `log_time` is the time of arrival in the recorder's
clock. The recorder requests the active rig and the robots from the server, so a recording contains everything
that a replay needs.
"""

import contextlib
import logging
import math
import queue
import threading
import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import zenoh

from calib.rig.recording import RecordingWriter, read_decoded, read_messages
from calib.rig.rig import Rig
from calib.rig.rig_messages import RigMessage
from camera_node.foundation.errors import ConfigError
from camera_node.protocol.messages import MAX_BYTES, Detections, Keys, MessageError, decode, encode
from camera_node.protocol.server_connection import ServerConnection
from fusion.model.limits import Limits
from fusion.model.robots import Robot
from fusion.protocol.installation import Installation, installation
from fusion.protocol.pose_messages import FusedFrames, FusionStatus, RobotPose, Robots, robots_key
from fusion.recordings.context import INSTALLATION
from fusion.recordings.rotation import RotatingWriter

log = logging.getLogger("fusion.recording")
Entry = tuple[str, bytes, int]  # key, data, time of arrival in ns
QUEUE_SIZE = 20_000
MAX_QUEUED_BYTES = 1 << 28
MAX_KEYS, MAX_KEY = 1024, 200  # the channels of a recording; characters of a key
WAIT_S = 0.1
# Between requests for the rig and the robots: the first one may precede the route to the server.
FIRST_PAUSE_S, LONGEST_PAUSE_S = 0.1, 1.0
PICTURE_S = 1.0  # between two pictures of a public recording
# For the answer of a busy server, also after the end of a recording: without the robots there is no replay.
ANSWER_S = 10.0
CHANGE_S = (
    LONGEST_PAUSE_S  # for that after a change, at the end of a recording that has robots: one more request
)
NO_ROBOTS = "no robot is declared: a replay of this recording needs --robots robots.yaml"
DETECTIONS, POSE, FRAMES = "/detections", "/pose", "/fusion/frames"  # the ends of keys
KINDS = {DETECTIONS: Detections, POSE: RobotPose, FRAMES: FusedFrames}


@dataclass
class ArenaRecording:
    """What a recording says of its arena, and its messages, which are read from the file when they are iterated."""

    path: Path | None = None
    limits: Limits | None = None  # of the server
    rig: Rig | None = None  # the first one
    robots: dict[str, Robot] = field(default_factory=dict)
    installation: Installation | None = None  # of a public recording
    faults: Counter[str] = field(default_factory=Counter)
    counts: Counter[str] = field(
        default_factory=Counter
    )  # messages that can be decoded, by the end of their keys

    def messages(self, *suffixes: str) -> Iterator[tuple[int, Any]]:
        """When each message on keys with these ends of `KINDS` arrived (ns), and the message, in the file's order.

        Each call reads the file, which may be larger than the memory.
        """
        if self.path:  # faults were counted when the recording was read first
            yield from read_decoded(self.path, {suffix: KINDS[suffix] for suffix in suffixes}, Counter())

    def add(self, key: str, data: bytes) -> None:
        """Take a recorded message; count it, or the fault if it can't be decoded."""
        try:
            for suffix, kind in KINDS.items():
                if key.endswith(suffix):
                    decode(data, kind)
                    self.counts[suffix] += 1
            if key.endswith("/fusion/status"):
                self.limits = decode(data, FusionStatus).limits
            elif key.endswith("/rig") and self.rig is None:
                self.rig = decode(data, RigMessage).rig
            elif key.endswith("/robots"):
                self.robots = decode(data, Robots).robots
            elif key.endswith(INSTALLATION):
                self.installation = decode(data, Installation)
        except MessageError:
            self.faults[f"undecodable messages on {key}"] += 1


def skipped(faults: Counter[str]) -> str:
    """What was skipped, for an error about what was not found; empty where nothing was."""
    reasons = ", ".join(f"{count} {reason}" for reason, count in faults.most_common())
    return f" (skipped: {reasons})" if reasons else ""


def read_recording(path: Path) -> ArenaRecording:
    """Read what a recording says of its arena, and count its messages; of a truncated one, everything before its end.

    Raises:
        ConfigError: the file is missing, or no recording of an arena.
    """
    recording = ArenaRecording(path)
    for key, data, _ in read_messages(path, recording.faults):
        recording.add(key, data)
    if not recording.counts[DETECTIONS]:
        raise ConfigError(f"{path} holds no detections; record with roundel record {path}")
    return recording


class ArenaRecorder:
    """Receives all messages of an arena and writes them. Time and memory stay bounded for any input.

    Args:
        connection: to the server; it stays open. Recording begins as soon as the server answers.
        arena: its name.
        writer: of the files.
        is_public: write also the versions of this installation, and a picture of one camera each second, so that others
            can judge by the recording.

    Attributes:
        lost: messages that were not written, by reason.
        robots: the names that the server declared last; None before its answer.
    """

    def __init__(
        self,
        connection: ServerConnection,
        arena: str,
        writer: RecordingWriter | RotatingWriter,
        is_public: bool = False,
    ) -> None:
        self.lost: Counter[str] = Counter()
        self.robots: frozenset[str] | None = None
        self._named: frozenset[str] | None = None  # robots of the last status
        self._connection, self._arena, self._writer = connection, arena, writer
        self._session: zenoh.Session | None = None
        self._subscriber: zenoh.Subscriber | None = None
        self._is_over = False
        # A server without a rig answers the second one only.
        self._missing = [Keys(arena).rig, robots_key(arena)]
        self._request_at_s, self._pause_s = 0.0, FIRST_PAUSE_S
        self._picture_at_s = 0.0 if is_public else math.inf
        self._received: queue.Queue[Entry] = queue.Queue(QUEUE_SIZE)
        self._lock = threading.Lock()
        self._queued_bytes = 0

    def run(self, stop: threading.Event, seconds: float | None = None) -> None:
        """Write until `stop` is set, or for `seconds`; then write what was received before.

        A recording without robots ends up to `ANSWER_S` later, with those that the server did not send yet. Others wait
        for a change of the robots up to `CHANGE_S`: any client can publish a status that names robots of its own.

        Raises:
            ConfigError: the disk is full; the file is closed.
        """
        end_s = time.monotonic() + (math.inf if seconds is None else seconds)
        self._connection.when_open(self._subscribe)
        if self._picture_at_s < math.inf:
            self._writer.put(self._arena + INSTALLATION, encode(installation()), time.time_ns())
        try:
            while not stop.is_set() and time.monotonic() < end_s:
                self._request_missing()
                self._request_picture()
                self._write_next(WAIT_S)
        finally:
            self._unsubscribe()
        self._write_queued()
        end_s = time.monotonic() + (ANSWER_S if self.robots is None else CHANGE_S)
        while self._writer.counts and robots_key(self._arena) in self._missing and time.monotonic() < end_s:
            self._request_missing()
            self._write_next(WAIT_S)
        self._write_queued()

    def _subscribe(self, session: zenoh.Session) -> None:
        with self._lock:
            if not self._is_over:
                self._subscriber = session.declare_subscriber(f"{self._arena}/**", self._enqueue)
                self._session = session

    def _unsubscribe(self) -> None:
        with self._lock:
            self._is_over, subscriber = True, self._subscriber
        if subscriber is not None:
            subscriber.undeclare()

    def _enqueue(self, sample: zenoh.Sample) -> None:
        """Queue a message; called from Zenoh's threads."""
        size, key = len(sample.payload), str(sample.key_expr)
        with self._lock:
            if len(key) > MAX_KEY:
                self.lost[f"messages on keys of more than {MAX_KEY} characters"] += 1
                return
            if size > MAX_BYTES:
                self.lost[f"messages of more than {MAX_BYTES} bytes"] += 1
                return
            if self._queued_bytes + size > MAX_QUEUED_BYTES or self._received.full():
                self.lost["messages that the disk was too slow for"] += 1
                return
            self._queued_bytes += size
            self._received.put_nowait((key, sample.payload.to_bytes(), time.time_ns()))

    def _write_queued(self) -> None:
        for _ in range(self._received.qsize()):
            self._write_next(0.0)

    def _write_next(self, timeout_s: float) -> None:
        try:
            key, data, received_ns = (
                self._received.get(timeout=timeout_s) if timeout_s else self._received.get_nowait()
            )
        except queue.Empty:
            return
        with self._lock:
            self._queued_bytes -= len(data)
        if key not in self._writer.counts and len(self._writer.counts) >= MAX_KEYS:
            self.lost[f"messages on more than {MAX_KEYS} keys"] += 1
            return
        self._writer.put(key, data, received_ns)
        if key in self._missing:
            self._missing.remove(key)
        if key in (robots_key(self._arena), Keys(self._arena).fusion_status):
            self._note_robots(key, data)

    def _note_robots(self, key: str, data: bytes) -> None:
        """Follow the declared robots: request them again when a status names others; invalid messages are skipped."""
        with contextlib.suppress(MessageError):
            if key == robots_key(self._arena):
                is_first, self.robots = self.robots is None, frozenset(decode(data, Robots).robots)
                if is_first and not self.robots:
                    log.warning(
                        "arena %s: %s; robots that are declared later are recorded",
                        self._arena,
                        NO_ROBOTS,
                    )
                return
            status = decode(data, FusionStatus)
            before, self._named = self._named, frozenset((*status.robots, *status.not_acquired))
            if self.robots is not None and self._named != (self.robots if before is None else before):
                self._missing = list({*self._missing, robots_key(self._arena)})

    def _request_missing(self) -> None:
        """Query the server for the rig and the robots; the replies are recorded as if they were published."""
        session = self._session
        if session is None or not self._missing or time.monotonic() < self._request_at_s:
            return
        self._request_at_s = time.monotonic() + self._pause_s
        self._pause_s = min(2 * self._pause_s, LONGEST_PAUSE_S)

        def take(reply: zenoh.Reply) -> None:
            if reply.ok is not None and str(reply.ok.key_expr) in self._missing:
                self._enqueue(reply.ok)

        for key in self._missing:
            session.get(key, take, timeout=ANSWER_S)

    def _request_picture(self) -> None:
        """Query the first camera by name for its picture from time to time; the reply is recorded under its key."""
        session, keys = self._session, Keys(self._arena)
        cameras = sorted(filter(None, map(keys.camera_in, self._writer.counts)))
        if session is None or not cameras or time.monotonic() < self._picture_at_s:
            return
        self._picture_at_s = time.monotonic() + PICTURE_S

        def take(reply: zenoh.Reply) -> None:
            if reply.ok is not None and str(reply.ok.key_expr) == keys.snapshot(cameras[0]):
                self._enqueue(reply.ok)

        session.get(keys.snapshot(cameras[0]), take, timeout=ANSWER_S)
