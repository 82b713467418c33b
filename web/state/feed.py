# SPDX-License-Identifier: BSD-3-Clause
"""Stores the latest message of each kind that an arena publishes, for the page and the status line."""

import logging
import math
import threading
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import msgspec
import numpy as np

from calib.rig.coverage import Coverage
from calib.rig.rig import Rig
from calib.rig.rig_messages import RigHistory, RigMessage
from camera_node.foundation.config import is_name
from camera_node.foundation.errors import printable
from camera_node.geometry.pose import Pose
from camera_node.protocol.messages import (
    VERSION,
    CameraStatus,
    Detections,
    Keys,
    MessageError,
    Preview,
    RelativePositions,
    decode,
)
from fusion.model.robots import Robot
from fusion.protocol.pose_messages import MAX_NUMBER, FusionStatus, Markers, RobotPose, Robots, robots_key

log = logging.getLogger("web")
MAX_NAMES = 256  # cameras or robots of one arena; the feed counts further ones as faults
REMOVED_S = 1.5  # a robot without poses for so long, which the server's status does not list, was removed
REMOVED_CAMERA_S = 5.0  # the same of a camera without a status
MAX_PENDING = 1024  # keys whose latest message is not decoded yet
COVERAGE_S = 0.1  # shortest time between two frames of a camera that extend its coverage
MAX_REASONS = 32  # distinct faults; the feed counts further ones as "others"
_CONTAINERS = (
    "poses",
    "cameras",
    "previews",
    "relative",
    "detections",
    "coverage",
    "message_counts",
    "faults",
)
Vector = tuple[float, float, float]


@dataclass(frozen=True)
class TimedMessage:
    """A message and its time of arrival, seconds of the feed's clock."""

    message: Any
    received_s: float


@dataclass
class ArenaState:
    """The latest messages of an arena at one moment of the feed's clock."""

    now_s: float = 0.0
    started_s: float = 0.0  # when the feed was created
    poses: dict[str, TimedMessage] = field(default_factory=dict)  # by robot
    cameras: dict[str, TimedMessage] = field(default_factory=dict)  # status of each camera
    previews: dict[str, TimedMessage] = field(default_factory=dict)  # picture of each camera
    detections: dict[str, Detections] = field(default_factory=dict)  # latest of each camera
    coverage: dict[str, Coverage] = field(default_factory=dict)  # by camera: where it saw roundels
    relative: dict[str, TimedMessage] = field(default_factory=dict)  # what each camera locates by itself
    markers: TimedMessage | None = None
    status: TimedMessage | None = None  # of the server
    progress: TimedMessage | None = None  # of the demo
    # The server's robots; another object if one changed.
    declared: dict[str, Robot] = field(default_factory=dict)
    rig: Rig | None = None
    rig_t_ns: int | None = None  # since when it is in force, server's time
    history: RigHistory | None = None  # the versions of the server's rig
    server_alive: bool = False
    arena: str = ""
    other_arenas: frozenset[str] = frozenset()  # whose servers are reached
    message_counts: Counter[str] = field(default_factory=Counter)  # by kind; frames by "frames <camera>"
    faults: Counter[str] = field(default_factory=Counter)  # skipped messages, by reason

    def declared_robots(self) -> tuple[str, ...]:
        """Names of the robots that the server tracks or looks for, sorted; empty before its first status."""
        status: FusionStatus | None = self.status.message if self.status else None
        return tuple(sorted({*status.robots, *status.not_acquired})) if status else ()

    def age_s(self, timed: TimedMessage | None) -> float:
        """Return the seconds since a message arrived; infinity for None."""
        return self.now_s - timed.received_s if timed else math.inf


@dataclass(frozen=True, slots=True)
class PendingMessage:
    """A message that is not decoded yet, its key expression and its time of arrival."""

    key_expr: str
    data: bytes
    received_s: float


class Feed:
    """Decodes the messages of an arena and stores the latest of each kind.

    Messages arrive through `receive`, from Zenoh (`web.state.subscription`) or from a recording
    (`web.state.recording_player`). Invalid messages are counted in `ArenaState.faults` and have no other effect. Poses,
    markers and detections arrive far more often than they are drawn: of each key, only the latest message is
    decoded, by `state`. All methods are thread-safe.
    """

    def __init__(
        self,
        arena: str,
        on_pose: Callable[[RobotPose], None] | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """Create an empty feed.

        Args:
            arena: name of the arena, the first part of its Zenoh keys.
            on_pose: is called with each valid pose, in the thread that calls `receive`; each pose is decoded then.
            clock: returns seconds. The clock of a recording may stand still.
        """
        self.keys = Keys(arena)
        self._on_pose, self._clock = on_pose, clock
        self._lock = threading.RLock()
        self._state = ArenaState(started_s=clock(), arena=arena)
        self._received_s = 0.0  # of the message that is being stored
        self._pending: dict[str, PendingMessage] = {}  # by key
        self._covered_s: dict[str, float] = {}  # when each camera's coverage was extended last
        keys = self.keys
        self._deferred = {keys.markers, keys.detections(), keys.relative()} | (
            {keys.robot_pose()} if on_pose is None else set()
        )
        self._kinds: dict[str, tuple[type[msgspec.Struct], Callable[[Any, str], None]]] = {
            keys.robot_pose(): (RobotPose, self._store_pose),
            keys.markers: (Markers, self._store_as("markers")),
            keys.fusion_status: (FusionStatus, self._store_status),
            keys.camera_status(): (CameraStatus, self._store_by("cameras", "camera")),
            keys.detections(): (Detections, self._add_coverage),
            keys.relative(): (RelativePositions, self._store_by("relative", "camera")),
            keys.preview(): (Preview, self._store_by("previews", "camera")),
            keys.rig: (RigMessage, self._store_rig),
            robots_key(arena): (Robots, self._store_robots),
            progress_key(arena): (DemoProgress, self._store_as("progress")),
        }

    @property
    def key_exprs(self) -> tuple[str, ...]:
        """The Zenoh key expressions of all messages that the feed decodes, without those that are sent on demand."""
        on_demand = self.keys.preview(), robots_key(self.keys.arena)
        return tuple(key for key in self._kinds if key not in on_demand)

    def receive(self, key_expr: str, key: str, data: bytes) -> None:
        """Store a message; `key_expr` is the one of `key_exprs` that includes its `key`."""
        if key_expr not in self._deferred:
            self._decode(key, PendingMessage(key_expr, data, self._clock()))
            return
        camera = self.keys.camera_in(key)
        with self._lock:
            if key not in self._pending and len(self._pending) >= MAX_PENDING:
                self.count_fault(f"more than {MAX_PENDING} keys")
                return
            self._pending[key] = PendingMessage(key_expr, data, self._clock())
            if camera in self._state.detections:
                self._state.message_counts[f"frames {camera}"] += 1

    def _decode(self, key: str, pending: PendingMessage) -> None:
        kind, store = self._kinds[pending.key_expr]
        try:
            message = decode(pending.data, kind)
            with self._lock:
                self._received_s = pending.received_s
                store(message, key)
                self._state.message_counts[kind.__name__] += 1
        except MessageError as error:
            self.count_fault(f"{kind.__name__}: {printable(error, 100)}")
        except Exception as error:  # of a bug that this message shows: the next one is another
            log.exception("a %s could not be stored", kind.__name__)
            self.count_fault(f"{kind.__name__}: {printable(repr(error), 100)}")

    def state(self) -> ArenaState:
        """Return a copy of the state, which later messages do not change."""
        with self._lock:
            pending, self._pending = self._pending, {}
            for key, message in pending.items():
                self._decode(key, message)
            copies = {name: getattr(self._state, name).copy() for name in _CONTAINERS}
            return replace(self._state, now_s=self._clock(), **copies)

    def note_arena(self, arena: str, alive: bool) -> None:
        """Store whether the server of an arena is running, of this one or of another that is reached."""
        with self._lock:
            if arena == self.keys.arena:
                self._state.server_alive = alive
            elif is_name(arena) and len(self._state.other_arenas) < MAX_NAMES:
                others = self._state.other_arenas
                self._state.other_arenas = others | {arena} if alive else others - {arena}

    def store_history(self, history: RigHistory) -> None:
        """Store the versions of the rig, which the server sends on request."""
        with self._lock:
            self._state.history = history

    def store_robots(self, robots: Robots) -> None:
        """Store the declared robots, which the server sends on request."""
        with self._lock:
            self._store_robots(robots, "")

    def clear(self) -> None:
        """Discard all messages; fault counts and the server's presence remain."""
        with self._lock:
            old = self._state
            self._pending, self._covered_s = {}, {}
            self._state = ArenaState(
                started_s=old.started_s,
                server_alive=old.server_alive,
                arena=old.arena,
                other_arenas=old.other_arenas,
                faults=old.faults,
            )

    def count_fault(self, reason: str, count: int = 1) -> None:
        """Count messages or drawings that were skipped."""
        with self._lock:
            faults = self._state.faults
            faults[reason if reason in faults or len(faults) < MAX_REASONS else "others"] += count

    def _store_as(self, name: str) -> Callable[[msgspec.Struct, str], None]:
        return lambda message, key: setattr(self._state, name, TimedMessage(message, self._received_s))

    def _store_pose(self, pose: RobotPose, key: str) -> None:
        self._store_by("poses", "robot")(pose, key)
        if self._on_pose is not None:
            self._on_pose(pose)

    def _store_status(self, status: FusionStatus, key: str) -> None:
        state = self._state
        state.status = TimedMessage(status, self._received_s)
        for robot in (
            state.poses.keys() - status.robots.keys() - status.not_acquired.keys()
        ):  # renamed or removed, unless it is new
            if self._clock() - state.poses[robot].received_s > REMOVED_S:
                del state.poses[robot]
        for camera in state.cameras.keys() - status.cameras.keys():  # renamed or forgotten, unless it is new
            if self._clock() - state.cameras[camera].received_s > REMOVED_CAMERA_S:
                for messages in (state.cameras, state.previews, state.detections, state.coverage):
                    messages.pop(camera, None)

    def _add_coverage(self, detections: Detections, key: str) -> None:
        camera, before = detections.camera, self._state.detections.get(detections.camera)
        _check_name(self._state.coverage, camera, key)
        if before is None:  # later frames are counted when they arrive
            self._state.message_counts[f"frames {camera}"] += 1
        self._state.detections[camera] = detections
        if self._received_s - self._covered_s.get(camera, -math.inf) < COVERAGE_S:
            return
        self._covered_s[camera] = self._received_s
        size = detections.width, detections.height
        covered = Coverage.of(np.frombuffer(detections.uv, "<f8"), *size)
        if before is not None and size == (before.width, before.height) and camera in self._state.coverage:
            covered += self._state.coverage[camera]
        self._state.coverage[camera] = covered

    def _store_rig(self, message: RigMessage, key: str) -> None:
        state = self._state
        if message.t_ns == state.rig_t_ns and message.rig == state.rig:  # a query repeats the one in force
            return
        state.rig, state.rig_t_ns = message.rig, message.t_ns

    def _store_robots(self, message: Robots, key: str) -> None:
        if message.robots != self._state.declared:
            self._state.declared = message.robots

    def _store_by(self, messages: str, field: str) -> Callable[[msgspec.Struct, str], None]:
        """Store messages in a dictionary of the state, by a name that they have in a field."""

        def store(message: msgspec.Struct, key: str) -> None:
            known, name = getattr(self._state, messages), getattr(message, field)
            _check_name(known, name, key)
            known[name] = TimedMessage(message, self._received_s)

        return store


def _check_name(known: dict[str, Any], name: str, key: str) -> None:
    """Raise MessageError if the name in a message differs from its key's, or if there are too many names."""
    if f"/{name}/" not in key or not name:
        raise MessageError(f"a name that differs from the one in the key {key}")
    if name not in known and len(known) >= MAX_NAMES:
        raise MessageError(f"more than {MAX_NAMES} names")


class DemoProgress(msgspec.Struct, frozen=True, kw_only=True):
    """A status line, the completed share of the current step, true marker positions and poses of moving cameras.

    `true_points` maps the name of a simulated object to its marker positions in the world, metres, and `true_cameras`
    the name of a camera that moves, which no rig can have, to its pose in the world. The viewer draws them. The
    encoding is that of `camera_node.protocol.messages`.
    """

    version: int = VERSION
    t_ns: int
    text: str
    share: float  # completed part of the current step, 0 to 1
    true_points: dict[str, tuple[Vector, ...]] = {}
    true_cameras: dict[str, Pose] = {}

    def check(self) -> None:
        """Raise MessageError unless `share` is within 0 to 1 and all coordinates are in range."""
        places = [point for points in self.true_points.values() for point in points]
        places += [pose.position_m for pose in self.true_cameras.values()]
        if not (0.0 <= self.share <= 1.0 and all(abs(x) <= MAX_NUMBER for place in places for x in place)):
            raise MessageError("a share outside 0 to 1, or a true position out of range")


def progress_key(arena: str) -> str:
    """The Zenoh key of `DemoProgress`."""
    return f"{arena}/demo/progress"
