# SPDX-License-Identifier: BSD-3-Clause
"""Everything that an arena says, kept at its latest: what the viewer draws and what the status line tells."""

import math
import threading
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import msgspec

from calib.rig.messages import RigMessage
from calib.rig.rig import Rig
from camera_node.protocol.messages import CameraStatus, Detections, Keys, MessageError, decode
from fusion.protocol.messages import FusionStatus, Markers, RobotPose
from web.coverage import Coverage
from web.messages import DemoProgress, progress_key

MAX_NAMES = 256  # cameras or robots of one arena; more are a fault of whoever publishes them
MAX_REASONS = 32
FAR_M = 1e5  # nothing of an arena is so far away


@dataclass(frozen=True)
class Seen:
    """A message and when it came, seconds of the feed's clock."""

    message: Any
    at: float


@dataclass
class Latest:
    """What is known of an arena at one moment."""

    now: float = 0.0  # seconds of the feed's clock
    poses: dict[str, Seen] = field(default_factory=dict)
    cameras: dict[str, Seen] = field(default_factory=dict)
    coverage: dict[str, Coverage] = field(default_factory=dict)
    markers: Seen | None = None
    status: Seen | None = None
    progress: Seen | None = None
    rig: Rig | None = None
    server_alive: bool = False
    received: Counter[str] = field(default_factory=Counter)  # messages by kind; frames by "frames <camera>"
    faults: Counter[str] = field(default_factory=Counter)  # what was skipped, by its reason

    def age(self, seen: Seen | None) -> float:
        """Seconds since a message came; infinite where there is none."""
        return self.now - seen.at if seen else math.inf


class Feed:
    """What an arena's messages say. Bad bytes are counted in `Latest.faults` and go no further.

    Messages come by `receive`: from Zenoh (`web.subscription`) or from a recording (`web.replay`), whose clock may
    stand still.
    """

    def __init__(
        self,
        arena: str,
        on_pose: Callable[[RobotPose], None] | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.keys = Keys(arena)
        self._on_pose, self._clock = on_pose, clock
        self._lock = threading.RLock()
        self._latest = Latest()
        keys = self.keys
        self._kinds: dict[str, tuple[type[msgspec.Struct], Callable[[Any, str], None]]] = {
            keys.robot_pose(): (RobotPose, self._take_pose),
            keys.markers: (Markers, self._keep("markers")),
            keys.fusion_status: (FusionStatus, self._keep("status")),
            keys.camera_status(): (CameraStatus, self._take_camera),
            keys.detections(): (Detections, self._take_detections),
            keys.rig: (RigMessage, self._take_rig),
            progress_key(arena): (DemoProgress, self._keep("progress")),
        }

    @property
    def key_exprs(self) -> tuple[str, ...]:
        """The Zenoh key expressions of all that is understood."""
        return tuple(self._kinds)

    def receive(self, key_expr: str, key: str, data: bytes) -> None:
        """A message on a key that one of `key_exprs` includes."""
        kind, take = self._kinds[key_expr]
        try:
            message = decode(data, kind)
            with self._lock:
                take(message, key)
                self._latest.received[kind.__name__] += 1
        except MessageError as error:
            self.count_fault(f"{kind.__name__}: {error}"[:120])

    def latest(self) -> Latest:
        """A copy that no later message changes."""
        with self._lock:
            latest = self._latest
            copies = {name: getattr(latest, name).copy() for name in _CONTAINERS}
            return replace(latest, now=self._clock(), **copies)

    def server_changed(self, alive: bool) -> None:
        """The server came or went."""
        with self._lock:
            self._latest.server_alive = alive

    def forget(self) -> None:
        """Know nothing, but what was skipped and whether the server is there."""
        with self._lock:
            known = self._latest
            self._latest = Latest(server_alive=known.server_alive, faults=known.faults)

    def count_fault(self, reason: str) -> None:
        """Count something of the arena that could not be shown."""
        with self._lock:
            faults = self._latest.faults
            faults[reason if reason in faults or len(faults) < MAX_REASONS else "others"] += 1

    def _keep(self, name: str) -> Callable[[msgspec.Struct, str], None]:
        return lambda message, key: setattr(self._latest, name, Seen(message, self._clock()))

    def _take_pose(self, pose: RobotPose, key: str) -> None:
        if max(map(abs, pose.position)) > FAR_M or math.hypot(*pose.quaternion_wxyz) < 1e-6:
            raise MessageError("a pose out of any arena, or without an orientation")
        self._store(self._latest.poses, pose.robot, pose, key)
        if self._on_pose is not None:
            self._on_pose(pose)

    def _take_camera(self, status: CameraStatus, key: str) -> None:
        self._store(self._latest.cameras, status.camera, status, key)

    def _take_detections(self, detections: Detections, key: str) -> None:
        camera, size = detections.camera, (detections.width, detections.height)
        _check_name(self._latest.coverage, camera, key)
        known = self._latest.coverage.get(camera)
        if known is None or known.size != size:
            known = self._latest.coverage[camera] = Coverage(*size)
        known.add(detections)
        self._latest.received[f"frames {camera}"] += 1

    def _take_rig(self, message: RigMessage, key: str) -> None:
        self._latest.rig = message.rig()

    def _store(self, into: dict[str, Seen], name: str, message: msgspec.Struct, key: str) -> None:
        _check_name(into, name, key)
        into[name] = Seen(message, self._clock())


_CONTAINERS = ("poses", "cameras", "coverage", "received", "faults")


def _check_name(known: dict[str, Any], name: str, key: str) -> None:
    if f"/{name}/" not in key or not name:
        raise MessageError(f"a name that is not the key's, on {key}")
    if name not in known and len(known) >= MAX_NAMES:
        raise MessageError(f"more than {MAX_NAMES} names")
