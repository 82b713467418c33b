# SPDX-License-Identifier: BSD-3-Clause
"""What the server says over Zenoh, in the encoding of `camera_node.protocol.messages`."""

import math
from typing import Literal

import msgspec
import numpy as np
from numpy.typing import NDArray

from camera_node.arrays import Array, Index
from camera_node.protocol.messages import VERSION, MessageError
from fusion.model.robots import Robot

Vector = tuple[float, float, float]
TrackingState = Literal["tracked", "coasting", "lost"]


class Latency(msgspec.Struct, frozen=True, kw_only=True):
    """Where the time went, from the newest exposure's middle to the pose's publication, milliseconds."""

    exposure_ms: float = 0.0  # middle of the exposure until its end; 0 where unknown
    detect_ms: float = 0.0  # from the frame in memory to the roundels
    camera_ms: float  # middle of the exposure until the message was sent: both of these, and read-out
    network_ms: float  # until the server had it
    wait_ms: float  # until the instant was complete
    fuse_ms: float  # association and estimation
    total_ms: float


class RobotPose(msgspec.Struct, frozen=True, kw_only=True):
    """Where a robot was at `t_ns`. While `lost` the last known pose stands there with its grown covariance.

    `position` and `velocity` (m/s) are the body's origin in the world; `quaternion_wxyz` turns the body into the world;
    `angular_velocity` (rad/s) is in the world. `covariance` is (12, 12) <f4, row by row, in GTSAM's order: rotation
    (vector in the body's frame), position (world), angular velocity (world), velocity (world). A robot of one marker
    has +z along the marker's normal and no known turn about it: its covariance says so.
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
    n_markers: int  # markers used in this instant
    cameras: tuple[str, ...] = ()  # cameras used in this instant
    residual_px: float | None = None  # RMS of the reprojection in this instant
    latency: Latency | None = None  # None offline

    def check(self) -> None:
        """Raise MessageError unless the numbers are finite, the quaternion is one and the covariance has its size."""
        numbers = (*self.position, *self.quaternion_wxyz, *self.velocity, *self.angular_velocity)
        if not any(self.quaternion_wxyz):
            raise MessageError("a pose whose quaternion is zero")
        if len(self.covariance) != 576 or not all(map(math.isfinite, numbers)):
            raise MessageError("a pose that is not finite, or a covariance that is not 12 x 12")

    @property
    def covariance_matrix(self) -> Array:
        """(12, 12) covariance: rotation, position, angular velocity, velocity."""
        return np.frombuffer(self.covariance, "<f4").reshape(12, 12).astype(float)


class ShardPoses(msgspec.Struct, frozen=True, kw_only=True):
    """Where all robots of one shard were at `t_ns`, for the other shards: their detections are claimed by it.

    Columns, one row a robot: `motion` (R, 13) <f8 position, quaternion wxyz, velocity and angular velocity,
    `covariance` (R, 144) <f4; all as in `RobotPose`.
    """

    version: int = VERSION
    t_ns: int
    robots: tuple[str, ...]
    states: tuple[TrackingState, ...]
    motion: bytes
    covariance: bytes

    def check(self) -> None:
        """Raise MessageError unless the columns' sizes agree, the numbers are finite and the quaternions are such."""
        n = len(self.robots)
        if (len(self.states), len(self.motion), len(self.covariance)) != (n, 104 * n, 576 * n):
            raise MessageError(f"columns of other sizes than {n} robots have")
        motion, covariance = self.motions(), np.frombuffer(self.covariance, "<f4")
        if not (np.isfinite(motion).all() and np.isfinite(covariance).all() and motion[:, 3:7].any(1).all()):
            raise MessageError("poses that are not finite, or a quaternion that is zero")

    def motions(self) -> Array:
        """(R, 13) positions, quaternions, velocities and angular velocities."""
        return np.frombuffer(self.motion, "<f8").reshape(-1, 13)

    def covariances(self) -> Array:
        """(R, 12, 12)."""
        return np.frombuffer(self.covariance, "<f4").reshape(-1, 12, 12).astype(float)


class Markers(msgspec.Struct, frozen=True, kw_only=True):
    """Every marker of a fused instant, labelled or not.

    Columns, one row a marker: `position` (M, 3) <f8 m, world; `covariance` (M, 9) <f4 m^2, row by row; `normal`
    (M, 3) <f4 unit vector out of the printed side and `velocity` (M, 3) <f4 m/s, NaN where unknown; `candidates` (M, 6)
    <f4 the two normals that one camera alone leaves, each as probable, NaN of other markers; `robot` (M,) <i4 index
    into `robots`, -1 for none; `marker` (M,) <i4 index in that robot, -1 for none; `cameras` (M,) <u8 bit k set where
    `camera_names[k]` saw it.
    """

    version: int = VERSION
    t_ns: int
    robots: tuple[str, ...]
    camera_names: tuple[str, ...]
    position: bytes
    covariance: bytes
    normal: bytes
    velocity: bytes = b""  # also empty: of a server that does not tell
    candidates: bytes = b""  # likewise
    robot: bytes
    marker: bytes
    cameras: bytes

    def __len__(self) -> int:
        return len(self.position) // 24

    def check(self) -> None:
        """Raise MessageError unless the columns' sizes agree."""
        n = len(self)
        sizes = {"position": 24, "covariance": 36, "normal": 12, "robot": 4, "marker": 4, "cameras": 8}
        for name, size in sizes.items():
            if len(getattr(self, name)) != n * size:
                raise MessageError(f"column {name} of {len(getattr(self, name))} bytes for {n} markers")
        for name, size in {"velocity": 12, "candidates": 24}.items():
            if len(getattr(self, name)) not in (0, size * n):
                raise MessageError(f"column {name} of {len(getattr(self, name))} bytes for {n} markers")

    def positions(self) -> Array:
        """(M, 3) positions, world."""
        return np.frombuffer(self.position, "<f8").reshape(-1, 3)

    def normals(self) -> NDArray[np.float32]:
        """(M, 3) unit vectors out of the printed sides, world; NaN where unknown."""
        return np.frombuffer(self.normal, "<f4").reshape(-1, 3)

    def velocities(self) -> NDArray[np.float32]:
        """(M, 3) m/s, world; NaN where unknown."""
        told = np.frombuffer(self.velocity, "<f4").reshape(-1, 3)
        return told if self.velocity else np.full((len(self), 3), np.nan, np.float32)

    def normal_candidates(self) -> NDArray[np.float32]:
        """(M, 2, 3) the normals that one camera alone leaves, each as probable; NaN of other markers."""
        told = np.frombuffer(self.candidates, "<f4").reshape(-1, 2, 3)
        return told if self.candidates else np.full((len(self), 2, 3), np.nan, np.float32)

    def robot_index(self) -> NDArray[np.int32]:
        """(M,) index into `robots`, -1 for none."""
        return np.frombuffer(self.robot, "<i4")

    def free(self) -> Index:
        """(F,) rows of the markers that no robot has and that are placed by more than one camera."""
        alone = np.isfinite(self.normal_candidates()).any((1, 2))
        return np.flatnonzero((self.robot_index() < 0) & ~alone)

    def camera_bits(self) -> NDArray[np.uint64]:
        """(M,) bit k set where `camera_names[k]` saw the marker."""
        return np.frombuffer(self.cameras, "<u8")


class CameraHealth(msgspec.Struct, frozen=True, kw_only=True):
    """What the server sees of one camera, over the last second."""

    fps: float
    lateness_ms: float  # middle of exposure to arrival, mean
    residual_px: float | None  # RMS of what was used, None where nothing was
    used: int  # detections that a robot or marker took
    unused: int  # detections that nothing took
    late: int  # frames dropped since the start because they came too late
    calibrated: bool
    aside: bool = False  # it was moved: its detections are set aside until it is placed anew
    shared: bool = False  # two nodes publish under its name


class FusionStatus(msgspec.Struct, frozen=True, kw_only=True):
    """How the server does, once a second. `faults` counts, since the start, what was skipped, by its reason."""

    version: int = VERSION
    t_ns: int
    instants_per_s: float
    latency_ms: float | None  # median over the last second, newest exposure to publication
    cpu: float  # this process's share of one core
    memory_mb: float
    cameras: dict[str, CameraHealth]
    robots: dict[str, TrackingState]
    faults: dict[str, int]
    misfits: dict[str, float] = {}  # RMS, pixels, of robots whose markers do not stand as declared


def robots_key(arena: str) -> str:
    """The queryable that takes a `RobotsRequest` and answers with `Robots`."""
    return f"{arena}/robots"


def shard_key(arena: str, index: int | str) -> str:
    """Where shard `index`, of several, tells the others of its robots: `ShardPoses` in every instant."""
    return f"{arena}/fusion/shard/{index}"


def undo_key(arena: str) -> str:
    """The queryable that takes back the last pose which the server found of a moved camera."""
    return f"{arena}/rig/undo"


class RobotsRequest(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What to change of the robots while the server runs; all of it or, if it makes no sense, nothing."""

    version: int = VERSION
    rename: dict[str, str] = {}  # old name -> new name, done first: a renamed robot stays tracked
    remove: tuple[str, ...] = ()
    define: dict[str, Robot] = {}  # new ones, or new markers of old ones, which are then searched for anew


class Robots(msgspec.Struct, frozen=True, kw_only=True):
    """The robots that the server looks for."""

    version: int = VERSION
    robots: dict[str, Robot]
