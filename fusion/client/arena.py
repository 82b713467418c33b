# SPDX-License-Identifier: BSD-3-Clause
"""Robot poses for programs: iterate, get the latest, register a callback, or use `async for`.

Needs no GTSAM and no SciPy. A reader that is slower than the poses gets the newest one and skips the others.

    with Arena.connect("tcp/host:7447", arena="demo") as arena:
        for pose in arena.robot("robot_a"):
            print(pose.t_ns, pose.position, pose.quaternion_wxyz)
"""

import threading
import time
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import zenoh

from calib.live.rig_requests import (
    request_rig_history,
    request_rig_message,
    set_rig,
    step_rig,
)
from calib.rig.rig import Rig
from calib.rig.rig_messages import RigHistory, RigMessage
from camera_node.foundation.config import require_name
from camera_node.foundation.errors import NetworkError
from camera_node.protocol.messages import CameraStatus, Keys, MessageError, RelativePositions, decode
from camera_node.protocol.presence import Presence, no_such
from camera_node.protocol.requests import RETRY_S, RequestSource
from camera_node.protocol.server_connection import LOCAL_SERVER, ServerConnection
from camera_node.protocol.session import ask_server, guarded
from fusion.client.server_time import ServerTimeReader
from fusion.client.streams import RobotStream, Stream, since_arrival
from fusion.model.robots import Robot as RobotBody
from fusion.protocol.arena_health import why_no_frames, why_no_markers, why_no_poses
from fusion.protocol.pose_messages import FusionStatus, Markers, RobotPose, RobotPoses, Robots, RobotsRequest
from fusion.protocol.robot_requests import change_robots, request_robots

TIMEOUT_S = 10.0
MAX_ROBOTS = 1024
STATUS_S = 3.0  # a server sends its status every second


class Arena:
    """A connection to an arena's server.

    Attributes:
        faults: undecodable messages, by kind.
        time: the server's time.

    Args:
        connection: to the server; it is closed with the arena.
        arena: its name.
        robot: receive the poses of this robot only; "*" for all.
    """

    def __init__(self, connection: ServerConnection, arena: str, robot: str = "*") -> None:
        self.keys = Keys(arena)
        self.faults: Counter[str] = Counter()
        self.connection = connection
        self._origin = f"from arena '{arena}' at {connection.endpoints}"
        self._lock = threading.Lock()
        self._robots: dict[str, RobotStream] = {}
        self._streams: dict[str, Stream] = {}
        self._newest: dict[str, tuple[RobotPose, float]] = {}  # and when it arrived
        self.time = ServerTimeReader(connection, self.keys)
        self._presence = Presence(arena, self.keys.camera_alive())
        connection.when_open(self._presence.watch)
        self._server_status: tuple[float, FusionStatus] | None = None  # when it arrived
        poses, cause = f"poses {self._origin}", self.why_no_poses
        self._all: Stream[RobotPose] = Stream(poses, TIMEOUT_S, cause, self._age)
        self._sets: Stream[Sequence[RobotPose]] = Stream(poses, TIMEOUT_S, cause, self._age_of_set)
        self._subscribe(
            self.keys.fusion_status, guarded("status", self._taker(FusionStatus, self._keep_status))
        )
        if robot == "*":
            self._subscribe(self.keys.poses, guarded("poses", self._taker(RobotPoses, self._deliver_all)))
        else:
            self._subscribe(self.keys.robot_pose(robot), guarded("a pose", self._take_pose))

    @property
    def session(self) -> zenoh.Session:
        """The Zenoh session, for what this class does not offer; it is closed with the arena.

        Raises:
            NetworkError: no server answers in time.
        """
        return self.connection.session(TIMEOUT_S)

    @property
    def origin(self) -> str:
        """Where the messages come from, for log lines: "from arena 'demo' at tcp/host:7447"."""
        return self._origin

    @classmethod
    def connect(cls, *endpoints: str, arena: str = "arena", zenoh_config: Path | None = None) -> "Arena":
        """Connect to "tcp/host:7447"; returns within half a second, and retries while no server answers.

        Raises:
            NetworkError: an endpoint is invalid.
        """
        return cls(ServerConnection(endpoints or LOCAL_SERVER.connect, zenoh_config), arena)

    def __enter__(self) -> "Arena":
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    def close(self) -> None:
        """End all iterations and the connection."""
        for stream in (self._all, self._sets, *self._robots.values(), *self._streams.values()):
            stream._close()
        self.time.close()
        self.connection.close()

    def robot(self, name: str, timeout_s: float | None = TIMEOUT_S) -> RobotStream:
        """The poses of a robot; iterating waits at most `timeout_s` for the next one (None: for ever)."""
        with self._lock:
            if name not in self._robots:
                content = f"pose of '{name}' {self._origin}"
                stream = RobotStream(
                    content, timeout_s, lambda: self.why_no_poses(name), self._age, self.time.now_ns
                )
                self._robots[name] = stream
                if name in self._newest:
                    stream._put(*self._newest[name])
            robot = self._robots[name]
        robot.timeout_s = timeout_s
        return robot

    def poses(self, timeout_s: float | None = TIMEOUT_S) -> Stream[RobotPose]:
        """The poses of all robots: every robot in every frame set. A callback receives all of them."""
        self._all.timeout_s = timeout_s
        return self._all

    def pose_sets(self, timeout_s: float | None = TIMEOUT_S) -> Stream[Sequence[RobotPose]]:
        """The poses of all robots, as the server publishes them: many at a time, with less work than one by one.

        Robots that were acquired or are lost are in another set of the same time than those that were tracked before.
        """
        self._sets.timeout_s = timeout_s
        return self._sets

    def age_s(self, message: RobotPose | Markers | FusionStatus) -> float:
        """The age of a message that a callback or an iteration received, seconds; as `Stream.age_s`."""
        return self.time.read().age_s(message.t_ns, time.monotonic())

    def why_no_poses(self, robot: str | None = None) -> str:
        """The cause why no pose arrives, of a robot or of any, in one sentence with what to do. It sends no request.

        The server is away, the arena has another name, no camera sends frames, none is calibrated, the robot is not
        declared or not seen; it names the arenas and robots that are there.
        """
        return self._why(lambda status: why_no_poses(status, robot))

    def _why(self, of_status: Callable[[FusionStatus], str]) -> str:
        """Why the server does not answer, or what its status says."""
        if cause := self._presence.why_no_server():
            return cause
        received_s, status = self._server_status or (0.0, None)
        if status is None or time.monotonic() - received_s > STATUS_S:
            return "the server runs, but its status has not arrived: it has just started, or it is overloaded"
        return (
            of_status(status) or "the server sends it now: wait longer, or check the network and the rights"
        )

    def robots(self) -> tuple[str, ...]:
        """Names of the robots whose poses were received so far."""
        return tuple(sorted(self._newest))

    def change_robots(
        self,
        rename: dict[str, str] | None = None,
        remove: Sequence[str] = (),
        define: dict[str, RobotBody] | None = None,
        replace: bool = False,
    ) -> dict[str, RobotBody]:
        """Rename, then remove, then define robots while the server runs, all or none.

        Defining a robot that exists is refused, unless `replace`.

        Returns:
            All robots that the server tracks after the change.

        Raises:
            FusionError: the server refuses the change; the message is the server's.
            NetworkError: no server answers in time.
        """
        request = RobotsRequest(
            rename=rename or {},
            remove=tuple(remove),
            define=define or {},
            replace=replace,
            source=RequestSource.of("fusion.client"),
        )
        return change_robots(self.session, self.keys.arena, request).robots

    def declared_robots(self) -> Robots:
        """All robots that the server tracks, with their markers, and the names that a restart would lose.

        Raises:
            NetworkError: no server answers in time.
        """
        return request_robots(self.session, self.keys.arena)

    def set_rig(self, rig: Rig) -> RigMessage:
        """Have the server use another rig.

        Returns:
            The rig in force.

        Raises:
            RequestError: the server refuses it; the message is the server's.
            NetworkError: no server answers in time.
        """
        return set_rig(self.session, self.keys.arena, rig, "fusion.client")

    def undo_rig(self) -> RigMessage:
        """Have the server undo the last change of its rig: a calibration, or its recalibration of a moved camera.

        Returns and raises as `set_rig`.
        """
        return step_rig(self.session, self.keys.arena, "undo", "fusion.client")

    def redo_rig(self) -> RigMessage:
        """Have the server redo the change of its rig that was undone last; returns and raises as `set_rig`."""
        return step_rig(self.session, self.keys.arena, "redo", "fusion.client")

    def rig_history(self) -> RigHistory:
        """All versions of the server's rig, oldest first; raises as `set_rig`."""
        return request_rig_history(self.session, self.keys.arena)

    def markers(self, timeout_s: float | None = TIMEOUT_S) -> Stream[Markers]:
        """All markers of every frame set."""
        return self._stream(
            self.keys.markers, Markers, "markers", timeout_s, lambda: self._why(why_no_markers), self._age
        )

    def status(self, timeout_s: float | None = TIMEOUT_S) -> Stream[FusionStatus]:
        """The server's status, once a second."""
        return self._stream(
            self.keys.fusion_status,
            FusionStatus,
            "status",
            timeout_s,
            lambda: self._why(lambda _: ""),
            self._age,
        )

    def camera_statuses(self, timeout_s: float | None = TIMEOUT_S) -> Stream[CameraStatus]:
        """The status of each camera, once a second."""
        return self._stream(
            self.keys.camera_status(),
            CameraStatus,
            "camera status",
            timeout_s,
            lambda: self._why(why_no_frames),
        )

    def relative(self, camera: str, timeout_s: float | None = TIMEOUT_S) -> Stream[RelativePositions]:
        """The roundels that a camera locates relative to itself, every frame; `unpack` gives arrays. Needs no server.

        Raises:
            ConfigError: no camera has such a name.
        """
        key = self.keys.relative(require_name(camera, "a camera"))
        if key not in self._streams:
            content = f"positions of '{camera}' {self._origin}"
            stream = self._streams[key] = Stream(content, timeout_s, lambda: self._why_not_located(camera))

            def put(message: RelativePositions) -> None:
                if message.camera == camera:
                    stream._put(message)
                else:
                    self.faults["RelativePositions"] += 1

            take = guarded(key, self._taker(RelativePositions, put))
            self._subscribe(key, take)
        self._streams[key].timeout_s = timeout_s
        return self._streams[key]

    def rig(self, timeout_s: float = TIMEOUT_S) -> Rig | None:
        """The active calibration, or None if the server has none.

        Raises:
            NetworkError: no server answers within `timeout_s`.
            RequestError: the server refuses until then, because all its clients together ask too often.
        """
        deadline = time.monotonic() + timeout_s
        while (left := deadline - time.monotonic()) > 0:
            # queried before the rig: a session that was just opened may reach the server between both queries
            is_reached = ask_server(self.session, self.keys.clock, min(left, 1.0)) is not None
            data = request_rig_message(self.session, self.keys.arena, left)
            if data is not None or is_reached:
                return None if data is None else self._read_rig(data)
            time.sleep(min(RETRY_S, left))
        raise NetworkError(f"no rig {self._origin} within {timeout_s:g} s; {self._why(lambda _: '')}")

    def _read_rig(self, data: bytes) -> Rig | None:
        try:
            return decode(data, RigMessage).rig
        except MessageError:
            self.faults["RigMessage"] += 1
            return None

    def _why_not_located(self, camera: str) -> str:
        cameras = self._presence.cameras  # this needs no server
        if cameras and camera not in cameras:
            return no_such("camera", camera, cameras)
        command = "roundel camera --rig RIG --diameter METRES"
        return (
            f"does it run with these options: {command}?"
            if cameras
            else f"no camera runs there: start {command}"
        )

    def _age(self, message: RobotPose | Markers | FusionStatus, received_s: float) -> float:
        return self.time.read().age_s(message.t_ns, received_s)

    def _age_of_set(self, poses: Sequence[RobotPose], received_s: float) -> float:
        return self._age(poses[0], received_s)

    def _stream(
        self,
        key: str,
        kind: type,
        content: str,
        timeout_s: float | None,
        cause: Callable[[], str],
        age: Callable[[Any, float], float] = since_arrival,
    ) -> Stream:
        if key not in self._streams:
            stream = self._streams[key] = Stream(f"{content} {self._origin}", timeout_s, cause, age)
            take = guarded(content, self._taker(kind, stream._put))
            self._subscribe(key, take)
        self._streams[key].timeout_s = timeout_s
        return self._streams[key]

    def _subscribe(self, key: str, take: Callable[[zenoh.Sample], None]) -> None:
        self.connection.when_open(lambda session: session.declare_subscriber(key, take))

    def _taker(self, kind: type, put: Callable[[Any], None]) -> Callable[[zenoh.Sample], None]:
        def take(sample: zenoh.Sample) -> None:
            try:
                message = decode(sample.payload.to_bytes(), kind)
            except MessageError:
                self.faults[kind.__name__] += 1
                return
            put(message)

        return take

    def _take_pose(self, sample: zenoh.Sample) -> None:
        def deliver(pose: RobotPose) -> None:
            if str(sample.key_expr) == self.keys.robot_pose(pose.robot):
                self._deliver([pose])
            else:
                self.faults["RobotPose"] += 1

        self._taker(RobotPose, deliver)(sample)

    def _keep_status(self, status: FusionStatus) -> None:
        self._server_status = time.monotonic(), status

    def _deliver_all(self, message: RobotPoses) -> None:
        self._deliver(message.poses)

    def _deliver(self, poses: Sequence[RobotPose]) -> None:
        admitted = [pose for pose in poses if self._admit(pose)]
        for pose in admitted:
            if pose.robot in self._robots:
                self._robots[pose.robot]._put(pose)
            self._all._put(pose)
        if admitted:
            self._sets._put(admitted)

    def _admit(self, pose: RobotPose) -> bool:
        """Store the robot's newest pose, unless there are too many robots."""
        with self._lock:
            is_admitted = pose.robot in self._newest or len(self._newest) < MAX_ROBOTS
            if is_admitted:
                self._newest[pose.robot] = pose, time.monotonic()
            else:
                self.faults["RobotPose"] += 1
        return is_admitted
