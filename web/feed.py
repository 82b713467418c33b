# SPDX-License-Identifier: BSD-3-Clause
"""Everything that an arena says, kept at its latest: what the viewer draws and what the status line tells."""

import math
import threading
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any, TypeVar

import msgspec
import zenoh

from calib.messages import RigMessage
from calib.rig import Rig
from camera_node.messages import CameraStatus, Detections, Keys, MessageError, decode
from fusion.messages import FusionStatus, Markers, RobotPose
from web.coverage import Coverage
from web.messages import Progress, progress_key

T = TypeVar("T", bound=msgspec.Struct)
MAX_NAMES = 256  # cameras or robots of one arena; more are a fault of whoever publishes them
MAX_REASONS = 32
FAR_M = 1e5  # nothing of an arena is so far away


@dataclass(frozen=True)
class Seen:
    """A message and when it came, seconds of `time.monotonic()`."""

    message: Any
    at: float

    def age(self) -> float:
        """Seconds since it came."""
        return time.monotonic() - self.at


@dataclass
class Latest:
    """What is known of an arena at one moment."""

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


class Feed:
    """Subscriptions to one arena. Bad bytes are counted in `Latest.faults` and go no further."""

    def __init__(
        self, session: zenoh.Session, arena: str, on_pose: Callable[[RobotPose], None] | None = None
    ) -> None:
        self.session, self.keys = session, Keys(arena)
        self._on_pose = on_pose
        self._lock = threading.RLock()
        self._latest = Latest()
        keys = self.keys
        self._subscribers: list[Any] = [
            self._subscribe(keys.robot_pose(), RobotPose, self._take_pose),
            self._subscribe(keys.markers, Markers, self._keep("markers")),
            self._subscribe(keys.fusion_status, FusionStatus, self._take_status),
            self._subscribe(keys.camera_status(), CameraStatus, self._take_camera),
            self._subscribe(keys.detections(), Detections, self._take_detections),
            self._subscribe(keys.rig, RigMessage, self._take_rig),
            self._subscribe(progress_key(arena), Progress, self._keep("progress")),
            session.liveliness().declare_subscriber(keys.fusion_alive, self._server_changed, history=True),
        ]

    def close(self) -> None:
        """Stop listening; the session stays open."""
        for subscriber in self._subscribers:
            subscriber.undeclare()

    def latest(self) -> Latest:
        """A copy that no later message changes."""
        with self._lock:
            latest = self._latest
            copies = {name: getattr(latest, name).copy() for name in _CONTAINERS}
            return replace(latest, **copies)

    def snapshot(self, camera: str, timeout_s: float = 2.0) -> bytes | None:
        """The JPEG that a camera sees now, or None where it does not answer in time."""
        replies = self.session.get(self.keys.snapshot(camera), timeout=timeout_s)
        return next((reply.ok.payload.to_bytes() for reply in replies if reply.ok is not None), None)

    def count_fault(self, reason: str) -> None:
        """Count something of the arena that could not be shown."""
        with self._lock:
            faults = self._latest.faults
            faults[reason if reason in faults or len(faults) < MAX_REASONS else "others"] += 1

    def _subscribe(self, key: str, kind: type[T], take: Callable[[T, str], None]) -> zenoh.Subscriber:
        return self.session.declare_subscriber(key, lambda sample: self._receive(sample, kind, take))

    def _receive(self, sample: zenoh.Sample, kind: type[T], take: Callable[[T, str], None]) -> None:
        try:
            message = decode(sample.payload.to_bytes(), kind)
            with self._lock:
                take(message, str(sample.key_expr))
                self._latest.received[kind.__name__] += 1
        except MessageError as error:
            self.count_fault(f"{kind.__name__}: {error}"[:120])

    def _keep(self, name: str) -> Callable[[msgspec.Struct, str], None]:
        return lambda message, key: setattr(self._latest, name, Seen(message, time.monotonic()))

    def _take_pose(self, pose: RobotPose, key: str) -> None:
        if max(map(abs, pose.position)) > FAR_M or math.hypot(*pose.quaternion_wxyz) < 1e-6:
            raise MessageError("a pose out of any arena, or without an orientation")
        self._store(self._latest.poses, pose.robot, pose, key)
        if self._on_pose is not None:
            self._on_pose(pose)

    def _take_status(self, status: FusionStatus, key: str) -> None:
        self._latest.status = Seen(status, time.monotonic())
        if self._latest.rig is None:  # the server may be known before its queryable is
            self._ask_rig()

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
        try:
            self._latest.rig = msgspec.yaml.decode(message.yaml, type=Rig)
        except Exception as error:  # whatever YAML trips over: the bytes come from the network
            raise MessageError(f"no rig.yaml: {error}") from None

    def _store(self, into: dict[str, Seen], name: str, message: msgspec.Struct, key: str) -> None:
        _check_name(into, name, key)
        into[name] = Seen(message, time.monotonic())

    def _server_changed(self, sample: zenoh.Sample) -> None:
        alive = sample.kind == zenoh.SampleKind.PUT
        with self._lock:
            self._latest.server_alive = alive
        if alive:  # whoever joins late asks for the calibration in force
            self._ask_rig()

    def _ask_rig(self) -> None:
        self.session.get(self.keys.rig, self._receive_reply, timeout=5.0)

    def _receive_reply(self, reply: zenoh.Reply) -> None:
        if reply.ok is not None:
            self._receive(reply.ok, RigMessage, self._take_rig)


_CONTAINERS = ("poses", "cameras", "coverage", "received", "faults")


def _check_name(known: dict[str, Any], name: str, key: str) -> None:
    if f"/{name}/" not in key or not name:
        raise MessageError(f"a name that is not the key's, on {key}")
    if name not in known and len(known) >= MAX_NAMES:
        raise MessageError(f"more than {MAX_NAMES} names")
