# SPDX-License-Identifier: BSD-3-Clause
"""The server's messages over Zenoh, in the encoding of `camera_node.protocol.messages`."""

import hashlib
import math
from collections.abc import Iterator, Sequence
from os import PathLike
from pathlib import Path
from typing import Literal

import msgspec
import numpy as np
from numpy.typing import NDArray

from camera_node.foundation.arrays import Array, Index
from camera_node.foundation.config import is_name
from camera_node.geometry.pose import rotation_from_wxyz, wxyz_from_rotation
from camera_node.protocol.messages import VERSION, MessageError
from camera_node.protocol.requests import RequestSource
from fusion.model.frames import FrameSet
from fusion.model.limits import Limits
from fusion.model.robots import Robot, load_robots, require_trackable, save_robots
from fusion.model.states import MAX_COAST_S, States, predict

Vector = tuple[float, float, float]
MAX_NUMBER = 1e5  # of a coordinate or velocity, in metres, m/s or rad/s
QUATERNION_SLACK = 1e-3  # of the length of a rotation's quaternion
TrackingState = Literal["tracked", "coasting", "lost"]
# What rounding the entries of a correlation matrix (12, 12) to <f4 may take from its smallest eigenvalue.
ROUNDED = 12 * 2.0**-24
ENLARGED = 1 + 2 * ROUNDED * np.eye(12)  # twice, because the variances are rounded, too


def covariance_bytes(P: Array) -> bytes:
    """Covariances (..., 12, 12) as <f4, with variances enlarged so that they stay positive definite: claims of metres
    along one line and tenths of millimetres across it need more digits than <f4 has."""
    return (P * ENLARGED).astype("<f4").tobytes()


class Latency(msgspec.Struct, frozen=True, kw_only=True):
    """Latency of a pose and its parts, from the middle of the newest exposure to publication, milliseconds."""

    exposure_ms: float = 0.0  # middle of the exposure until its end; 0 where unknown
    detect_ms: float = 0.0  # from the frame in memory to the roundels
    camera_ms: float  # middle of the exposure until the message was sent: both of the above, and read-out
    network_ms: float  # until the server received it
    wait_ms: float  # until the frame set was complete
    fuse_ms: float  # association and estimation
    total_ms: float


class RobotPose(msgspec.Struct, frozen=True, kw_only=True):
    """The pose of a robot at `t_ns`. While the robot is `lost`, it is the last known pose with its grown covariance.

    `position` (m) and `velocity` (m/s) are those of the body's origin in the world; `quaternion_wxyz` rotates the body
    into the world; `angular_velocity` (rad/s) is in the world. `covariance` is (12, 12) <f4, row by row, in GTSAM's
    order: rotation (vector in the body's frame), position (world), angular velocity (world), velocity (world). The +z
    axis of a robot with one marker is the marker's normal; the covariance of its rotation about that axis is large.
    `at` predicts it for another time.
    """

    version: int = VERSION
    robot: str
    t_ns: int
    state: TrackingState
    position: Vector
    quaternion_wxyz: tuple[float, float, float, float]
    velocity: Vector
    angular_velocity: Vector
    covariance: bytes
    n_markers: int  # markers used in this frame set
    cameras: tuple[str, ...] = ()  # cameras used in this frame set
    residual_px: float | None = None  # RMS reprojection error in this frame set
    latency: Latency | None = None  # None offline
    evidence_age_s: float | None = None  # from the newest frame set in which a camera saw the robot to `t_ns`
    body_markers: int = 0  # markers of the robot; 0 if the server does not say it
    has_code: bool = False  # of a marker: then a robot of one marker has a heading
    # Power spectral densities of its white angular and linear acceleration, rad^2/s^3 and m^2/s^3.
    acceleration_density: tuple[float, float] | None = None

    def check(self) -> None:
        """Raise MessageError unless numbers are in range, the quaternion has length 1 and the covariance is 12 x 12."""
        if not is_name(self.robot):
            raise MessageError("an invalid robot name")
        numbers = (*self.position, *self.quaternion_wxyz, *self.velocity, *self.angular_velocity)
        if not abs(math.hypot(*self.quaternion_wxyz) - 1.0) < QUATERNION_SLACK:
            raise MessageError("the pose's quaternion is not of length 1")
        if len(self.covariance) != 576 or not all(abs(x) <= MAX_NUMBER for x in numbers):
            raise MessageError("the pose is out of range, or its covariance is not 12 x 12")
        motion = (self.evidence_age_s or 0.0, self.body_markers, *(self.acceleration_density or ()))
        if not all(0 <= x <= MAX_NUMBER for x in motion):
            raise MessageError("the pose's age, number of markers or density of acceleration is out of range")

    @property
    def covariance_matrix(self) -> Array:
        """(12, 12) covariance: rotation, position, angular velocity, velocity."""
        return np.frombuffer(self.covariance, "<f4").reshape(12, 12).astype(float)

    def at(self, t_ns: int) -> "RobotPose":
        """The pose predicted for another time, by the filter's own motion model, with its covariance.

        Velocities stay; white noise on accelerations widens the covariance, also towards times before `t_ns`. A lost
        robot stays where it was.

        Args:
            t_ns: in the server's time.

        Raises:
            ValueError: the message has no `acceleration_density`, as those of servers before 0.1, or the time is more
                than 30 s away.
        """
        dt = (t_ns - self.t_ns) * 1e-9
        if self.acceleration_density is None:
            raise ValueError(
                f"the pose of '{self.robot}' does not say how its robot moves: update the server"
            )
        if not abs(dt) <= MAX_COAST_S:
            raise ValueError(f"{dt:g} s from the pose of '{self.robot}'; {MAX_COAST_S:g} s at most")
        if dt == 0 or self.state == "lost":
            return msgspec.structs.replace(self, t_ns=t_ns)
        direction = np.repeat([1.0, np.copysign(1.0, dt)], 6)  # of the errors of pose and of velocities
        known = States(
            rotation_from_wxyz(self.quaternion_wxyz)[None],
            np.array([self.position]),
            direction[-1] * np.array([self.angular_velocity]),
            direction[-1] * np.array([self.velocity]),
            (direction[:, None] * self.covariance_matrix * direction)[None],
        )
        densities, single = (
            np.array([self.acceleration_density]),
            np.array([self.body_markers == 1 and not self.has_code]),
        )
        predicted, _ = predict(known, np.array([abs(dt)]), densities, single)
        P = direction[:, None] * predicted.P[0] * direction
        return msgspec.structs.replace(
            self,
            t_ns=t_ns,
            position=tuple(predicted.p[0].tolist()),
            quaternion_wxyz=tuple(wxyz_from_rotation(predicted.R[0]).tolist()),
            covariance=covariance_bytes(P),
            evidence_age_s=None if self.evidence_age_s is None else max(self.evidence_age_s + dt, 0.0),
        )


class RobotPoses(msgspec.Struct, frozen=True, kw_only=True):
    """The poses that the server publishes at the same moment, of many robots.

    A reader of all robots decodes this one message in place of each robot's. The robots that were tracked before come
    first; those that were acquired or are lost follow in another message of the same frame set.
    """

    version: int = VERSION
    poses: tuple[RobotPose, ...]

    @staticmethod
    def join(encoded: Sequence[bytes]) -> bytes:
        """The message of poses that are encoded already."""
        return msgspec.msgpack.encode({"version": VERSION, "poses": [msgspec.Raw(pose) for pose in encoded]})

    def check(self) -> None:
        """Raise MessageError unless each pose is valid, and none has another version."""
        for pose in self.poses:
            if pose.version != VERSION:
                raise MessageError(f"a pose of version {pose.version}; this program supports {VERSION}")
            pose.check()


# Bytes of a marker in each column of `Markers`, and the columns that older servers do not publish.
MARKER_COLUMNS = {
    "position": 24,
    "covariance": 36,
    "normal": 12,
    "velocity": 12,
    "candidates": 24,
    "diameter": 4,
}
MARKER_COLUMNS |= {"code": 4, "zero": 12, "robot": 4, "marker": 4, "cameras": 8}
OPTIONAL_COLUMNS = frozenset({"velocity", "candidates", "diameter", "code", "zero"})


class Markers(msgspec.Struct, frozen=True, kw_only=True):
    """All markers of a frame set, labeled and unlabeled.

    Columns, one row a marker: `position` (M, 3) <f8 m, world; `covariance` (M, 9) <f4 m^2, row by row; `normal`
    (M, 3) <f4 unit vector out of the printed side and `velocity` (M, 3) <f4 m/s, NaN where unknown; `candidates` (M, 6)
    <f4 the two equally probable normals of a marker that one camera sees, NaN for other markers; `diameter` (M,) <f4 m
    of the disc of an unlabeled marker as two or more cameras see it, NaN for other markers; `code` (M,) <i4 of an
    unlabeled marker, 0 for none, and `zero` (M, 3) <f4 unit vector to the zero of that code, world, NaN where unknown;
    `robot` (M,) <i4 index into `robots`, -1 for an unlabeled marker; `marker` (M,) <i4 index in that robot, or -1;
    `cameras` (M,) <u8 bit k set if `camera_names[k]` saw it.
    """

    version: int = VERSION
    t_ns: int
    robots: tuple[str, ...]
    camera_names: tuple[str, ...]
    position: bytes
    covariance: bytes
    normal: bytes
    velocity: bytes = b""  # empty if the server does not publish it
    candidates: bytes = b""  # empty if the server does not publish it
    diameter: bytes = b""  # empty if the server does not publish it
    code: bytes = b""  # empty if the server does not publish it
    zero: bytes = b""  # empty if the server does not publish it
    robot: bytes
    marker: bytes
    cameras: bytes

    def __len__(self) -> int:
        return len(self.position) // 24

    def check(self) -> None:
        """Raise MessageError unless the columns' sizes agree, and positions and robots are in range."""
        n = len(self)
        for name, size in MARKER_COLUMNS.items():
            length = len(getattr(self, name))
            if length != size * n and (length or name not in OPTIONAL_COLUMNS):
                raise MessageError(f"column {name} has {length} bytes for {n} markers")
        if not (np.abs(self.positions()) <= MAX_NUMBER).all():  # False for NaN
            raise MessageError("a position is out of range")
        if not (self.robot_index() < len(self.robots)).all():
            raise MessageError("a marker of a robot that the message does not name")

    def positions(self) -> Array:
        """(M, 3) positions, world."""
        return np.frombuffer(self.position, "<f8").reshape(-1, 3)

    def normals(self) -> NDArray[np.float32]:
        """(M, 3) unit vectors out of the printed sides, world; NaN where unknown."""
        return np.frombuffer(self.normal, "<f4").reshape(-1, 3)

    def velocities(self) -> NDArray[np.float32]:
        """(M, 3) velocities, m/s, world; NaN where unknown."""
        velocities = np.frombuffer(self.velocity, "<f4").reshape(-1, 3)
        return velocities if self.velocity else np.full((len(self), 3), np.nan, np.float32)

    def normal_candidates(self) -> NDArray[np.float32]:
        """(M, 2, 3) the equally probable normals of markers that one camera sees; NaN for other markers."""
        candidates = np.frombuffer(self.candidates, "<f4").reshape(-1, 2, 3)
        return candidates if self.candidates else np.full((len(self), 2, 3), np.nan, np.float32)

    def diameters(self) -> NDArray[np.float32]:
        """(M,) diameters of the discs of unlabeled markers as they appear, metres; NaN where unknown."""
        diameters = np.frombuffer(self.diameter, "<f4")
        return diameters if self.diameter else np.full(len(self), np.nan, np.float32)

    def codes(self) -> NDArray[np.int32]:
        """(M,) codes of unlabeled markers; 0 for none."""
        return np.frombuffer(self.code, "<i4") if self.code else np.zeros(len(self), np.int32)

    def zeros(self) -> NDArray[np.float32]:
        """(M, 3) unit vectors to the zeros of the codes, world; NaN where unknown."""
        zeros = np.frombuffer(self.zero, "<f4").reshape(-1, 3)
        return zeros if self.zero else np.full((len(self), 3), np.nan, np.float32)

    def robot_index(self) -> NDArray[np.int32]:
        """(M,) index into `robots`, -1 for unlabeled markers."""
        return np.frombuffer(self.robot, "<i4")

    def marker_index(self) -> NDArray[np.int32]:
        """(M,) index in the robot's markers, -1 for unlabeled markers."""
        return np.frombuffer(self.marker, "<i4")

    def unlabeled(self) -> Index:
        """(F,) rows of the unlabeled markers that more than one camera sees."""
        is_single_view = np.isfinite(self.normal_candidates()).any((1, 2))
        return np.flatnonzero((self.robot_index() < 0) & ~is_single_view)

    def camera_bits(self) -> NDArray[np.uint64]:
        """(M,) bit k set if `camera_names[k]` saw the marker."""
        return np.frombuffer(self.cameras, "<u8")


class FusedFrames(msgspec.Struct, frozen=True, kw_only=True):
    """The frames of a frame set, so that a replay fuses the same frames as the server did.

    Columns, one row a frame: `stamps` (F,) <i8 the `t_ns` of its `Detections`; `times` (F,) <i8 its capture time as it
    was used, ns; `clock_sigmas` (F,) <f8 the standard deviation of that by the clock, seconds; `stamp_sigmas` (F,) <f8
    that by errors of single stamps, and `arrivals` (F,) <i8 when the messages arrived, ns; both empty of older servers.
    `judged`: how many judgements of the cameras, which run
    beside tracking, the server took after it; None of older servers.
    """

    version: int = VERSION
    t_ns: int
    cameras: tuple[str, ...]
    stamps: bytes
    times: bytes
    clock_sigmas: bytes
    stamp_sigmas: bytes = b""
    arrivals: bytes = b""
    judged: int | None = None

    @classmethod
    def of(cls, frame_set: FrameSet, judged: int) -> "FusedFrames":
        """The message of a frame set, after which so many judgements of the cameras were taken."""
        frames = frame_set.frames
        return cls(
            t_ns=frame_set.t_ns,
            cameras=tuple(frame.camera for frame in frames),
            stamps=np.array([frame.stamp_ns for frame in frames], "<i8").tobytes(),
            times=np.array([frame.t_ns for frame in frames], "<i8").tobytes(),
            clock_sigmas=np.array([frame.clock_sigma_s for frame in frames], "<f8").tobytes(),
            stamp_sigmas=np.array([frame.stamp_sigma_s for frame in frames], "<f8").tobytes(),
            arrivals=np.array([frame.received_ns for frame in frames], "<i8").tobytes(),
            judged=judged,
        )

    def check(self) -> None:
        """Raise MessageError unless the columns' sizes agree."""
        n = 8 * len(self.cameras)
        columns = (
            self.stamps,
            self.times,
            self.clock_sigmas,
            self.stamp_sigmas or bytes(n),
            self.arrivals or bytes(n),
        )
        if any(len(column) != n for column in columns):
            raise MessageError(f"the columns have other sizes than those of {len(self.cameras)} frames")

    def rows(self) -> list[tuple[str, int, int, int, float, float]]:
        """Camera, stamp, capture time, arrival (ns; 0 where unknown), and the standard deviations of the capture time
        by the clock and by single stamps (s), of each frame."""
        unknown = bytes(len(self.stamps))
        of_times = self.stamps, self.times, self.arrivals or unknown
        of_sigmas = self.clock_sigmas, self.stamp_sigmas or unknown
        times = [np.frombuffer(column, "<i8").tolist() for column in of_times]
        sigmas = [np.frombuffer(column, "<f8").tolist() for column in of_sigmas]
        return list(zip(self.cameras, *times, *sigmas, strict=True))


SKIPPED_S = 10  # seconds, of `CameraHealth.skipped`


class CameraHealth(msgspec.Struct, frozen=True, kw_only=True):
    """The server's figures of one camera over the last second."""

    fps: float
    lateness_ms: float  # middle of exposure to arrival, mean
    residual_px: float | None  # RMS reprojection error of assigned detections, None without any
    assigned: int  # detections that were assigned to a robot or an unlabeled marker
    unassigned: int  # the other ones
    late: int  # frames dropped since the start because they arrived too late
    calibrated: bool
    excluded: bool = False  # the camera was moved: in the last second its detections were not used
    frozen: bool = False  # the camera repeats an old image: excluded until it delivers new ones
    duplicate_publisher: bool = False  # two nodes publish under its name
    faults: dict[str, int] = {}  # what was skipped of it since the server started, by reason
    skipped: dict[
        str, int
    ] = {}  # frames of the last `SKIPPED_S` that were not used: refused or late, by reason
    clock: str = "correct"  # or "corrected", or "uncertain" while its stamps may have jumped
    clock_correction_ms: float = 0.0  # added to its stamps
    clock_sigma_ms: float = 0.0  # standard deviation of the correction


class Contradiction(msgspec.Struct, frozen=True, kw_only=True):
    """Residuals of the last seconds that are larger than claimed, or exchanged names of cameras.

    Attributes:
        kind: "camera": all fits without it; "robot": the others of its cameras fit; "undecided": no single camera
            explains it, or several do; "wand": the whole rig has another size than the robots; "names": the names of
            cameras are exchanged.
        names: the camera, the robot, or the cameras that contradict each other; of exchanged names, each camera shows
            what the next one should, and the last what the first should.
        error_over_claim: squared residuals over their expectation, of the robot that contradicts most; 0 of names.
        size_mm: of the errors at the robots, RMS; 0 of names.
    """

    kind: Literal["camera", "robot", "undecided", "wand", "names"]
    names: tuple[str, ...]
    error_over_claim: float
    size_mm: float


class FusionStatus(msgspec.Struct, frozen=True, kw_only=True):
    """The server's status, once a second. `faults` counts what was skipped since the start, by its reason."""

    version: int = VERSION
    t_ns: int
    frame_sets_per_s: float  # fused; each has a pose of every robot
    latency_ms: float | None  # median over the last second, newest exposure to publication
    cpu: float  # this process's share of one core
    memory_mb: float
    cameras: dict[str, CameraHealth]
    robots: dict[str, TrackingState]
    faults: dict[str, int]
    limits: Limits | None = None  # with which the server tracks, for a replay
    measured_diameters_m: dict[str, float] = {}  # of the discs of robots that declare another diameter
    not_acquired: dict[str, str] = {}  # why, by robot
    contradictions: tuple[Contradiction, ...] = ()  # of residuals to their claims
    unsaved_robots: tuple[str, ...] = ()  # names whose changes a restart would undo
    rig_t_ns: int | None = None  # `RigMessage.t_ns` of the rig in force; None without one
    robots_digest: str | None = None  # `robots_digest()` of the robots in use


def robots_key(arena: str) -> str:
    """The key of the queryable that answers with `Robots`, and on which the server publishes them after a change."""
    return f"{arena}/robots"


def set_robots_key(arena: str) -> str:
    """The key of the queryable that takes a `RobotsRequest` and answers with `Robots`.

    A key of its own, because access rights cannot tell a query with a payload from one without.
    """
    return f"{arena}/robots/set"


def frames_key(arena: str) -> str:
    """The key on which the server publishes `FusedFrames` for every frame set."""
    return f"{arena}/fusion/frames"


class RobotsRequest(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Changes of the robots while the server runs: all of them, or none if the request is invalid."""

    version: int = VERSION
    rename: dict[str, str] = {}  # old name -> new name, applied first; a renamed robot stays tracked
    remove: tuple[str, ...] = ()
    define: dict[
        str, Robot
    ] = {}  # new robots, or with `replace` new markers of old ones, which are acquired again
    replace: bool = False  # otherwise `define` with the name of another robot is refused
    source: RequestSource | None = None


def robots_digest(robots: dict[str, Robot]) -> str:
    """What distinguishes robots from others: the start of the SHA-256 of their message."""
    return hashlib.sha256(msgspec.msgpack.encode(robots, order="deterministic")).hexdigest()[:16]


class Robots(msgspec.Struct, frozen=True, kw_only=True):
    """Robots by name: those of `robots.yaml`, or those that the server tracks.

    Attributes:
        robots: by name.
        unsaved: names whose changes a restart of the server would undo.
        renamed: by the change that is published: old name -> new name.
    """

    version: int = VERSION
    robots: dict[str, Robot]
    unsaved: tuple[str, ...] = ()
    renamed: dict[str, str] = {}

    @classmethod
    def load(cls, path: str | PathLike[str]) -> "Robots":
        """Read `robots.yaml`.

        Raises:
            ConfigError: the file is missing or broken, or declares no robot.
            FusionError: a constellation is symmetric, or two robots look alike.
        """
        return cls(robots=load_robots(Path(path)))

    def save(self, path: str | PathLike[str]) -> None:
        """Write `robots.yaml` atomically. Raises as `load`, and ConfigError if the folder is not writable."""
        require_trackable(self.robots, str(path))
        save_robots(self.robots, Path(path))

    def __getitem__(self, name: str) -> Robot:
        return self.robots[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self.robots)
