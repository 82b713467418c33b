# SPDX-License-Identifier: BSD-3-Clause
"""One robot's poses to an autopilot (PX4, ArduPilot) over MAVLink 2 and UDP: ODOMETRY or VISION_POSITION_ESTIMATE.

The autopilot asks for our time by TIMESYNC; the answer is the server's time, in which the poses are stamped. While the
robot is lost, heartbeats have the state critical, and ODOMETRY says by its quality that the odometry has failed.
"""

import re
import select
import socket
import time
from collections import Counter
from typing import Any, Literal

from camera_node.foundation.errors import ConfigError, NetworkError
from camera_node.foundation.extras import require
from camera_node.geometry.pose import wxyz_from_rotation
from fusion.bridges.mavlink_check import AutopilotCheck
from fusion.bridges.mavlink_frames import FrdFrames, FrdPose, roll_pitch_yaw, upper_triangle
from fusion.bridges.pose_queue import WAIT_S, PoseQueue
from fusion.client.server_time import ServerTimeReader
from fusion.protocol.pose_messages import FusionStatus, RobotPose

ADDRESS = re.compile(r"udp:(?P<host>[^\s:]+|\[[0-9a-fA-F:]+\]):(?P<port>\d{1,5})")
HEARTBEAT_S = 1.0
GAP_S = 1.0  # without poses, after which the next one counts as a reset
MAX_DATAGRAMS = 64  # taken at a time
UNKNOWN, FAILED = 0, -1  # of ODOMETRY's quality


class RateDivider:
    """Passes poses at most `rate_hz` times a second, in their own time; the rate is exact on average."""

    def __init__(self, rate_hz: float) -> None:
        """Raises ConfigError where the rate is not within 1 and 200."""
        if not 1 <= rate_hz <= 200:
            raise ConfigError(f"--rate-hz {rate_hz:g} is not within 1 and 200; autopilots expect 30 to 50")
        self._period_ns, self._due_ns = round(1e9 / rate_hz), 0

    def passes(self, t_ns: int) -> bool:
        """Whether a pose of this time is due."""
        if abs(t_ns - self._due_ns) > self._period_ns:  # the first one, after a gap, or another server's time
            self._due_ns = t_ns
        if t_ns < self._due_ns:
            return False
        self._due_ns += self._period_ns
        return True


class ResetCounter:
    """Counts events after which a pose may differ from the ones before it, modulo 256.

    These are: the robot was lost or silent, and the server uses another calibration.
    """

    def __init__(self) -> None:
        self.count = 0
        self._last_ns: int | None = None
        self._rig_t_ns: int | None = None

    def add_pose(self, pose: RobotPose) -> None:
        """Count a robot that was lost or silent before this pose; lost poses are to be left out."""
        if self._last_ns is not None and not 0 <= pose.t_ns - self._last_ns <= GAP_S * 1e9:
            self._reset()
        self._last_ns = pose.t_ns

    def add_loss(self) -> None:
        """The robot is lost: its next pose counts as a reset."""
        if self._last_ns is not None:
            self._last_ns = -(1 << 62)

    def add_status(self, status: FusionStatus) -> None:
        """Count another calibration."""
        if self._rig_t_ns is not None and status.rig_t_ns not in (None, self._rig_t_ns):
            self._reset()
        self._rig_t_ns = status.rig_t_ns or self._rig_t_ns

    def _reset(self) -> None:
        self.count = (self.count + 1) % 256


class MavlinkVehicle:
    """An autopilot at a UDP address; a context manager.

    Args:
        to: `udp:HOST:PORT`.
        system: MAVLink's number of the vehicle, which is also ours.

    Raises:
        ConfigError: the address or the number is invalid, or pymavlink is missing.
        NetworkError: the host is not known.

    Attributes:
        faults: what was not sent or not understood, by reason.
    """

    def __init__(self, to: str, system: int = 1) -> None:
        self.faults: Counter[str] = Counter()
        if not 1 <= system <= 255:
            raise ConfigError(f"--system {system} is none of MAVLink; give a number from 1 to 255")
        self._mavlink = require("pymavlink.dialects.v20.common", "mavlink", "roundel mavlink")
        self._socket = connect(to)
        self._encoder = self._mavlink.MAVLink(
            None, system, self._mavlink.MAV_COMP_ID_VISUAL_INERTIAL_ODOMETRY
        )
        self._encoder.robust_parsing = True  # bad bytes become a message of their own kind
        self._heartbeat_s = 0.0

    def __enter__(self) -> "MavlinkVehicle":
        return self

    def __exit__(self, *exception: object) -> None:
        self._socket.close()

    def fileno(self) -> int:
        """Of the socket, for `select`."""
        return self._socket.fileno()

    def beat(self, condition: Literal["STANDBY", "ACTIVE", "CRITICAL"]) -> bool:
        """Send a heartbeat if one is due, and return whether it is: routers forward to programs that have one.

        Args:
            condition: MAVLink's state: before the first pose, with poses, and while the robot is lost.
        """
        if time.monotonic() < self._heartbeat_s:
            return False
        self._heartbeat_s = time.monotonic() + HEARTBEAT_S
        m = self._mavlink
        state = getattr(m, f"MAV_STATE_{condition}")
        self._send(
            m.MAVLink_heartbeat_message(
                m.MAV_TYPE_ONBOARD_CONTROLLER, m.MAV_AUTOPILOT_INVALID, 0, 0, state, 3
            )
        )
        return True

    def answer(self, now_ns: int | None) -> list[Any]:
        """Answer the requests for the time that have arrived; return all messages.

        Args:
            now_ns: the server's present time; None if it is not known: then nothing is answered.
        """
        messages = []
        for _ in range(MAX_DATAGRAMS):
            try:
                data = self._socket.recv(2048)
            except BlockingIOError:
                break
            except OSError:  # nothing listens there yet
                continue
            messages += self._parse(data)
        for message in messages:
            if now_ns is not None and message.get_type() == "TIMESYNC" and message.tc1 == 0:
                self._send(self._mavlink.MAVLink_timesync_message(now_ns, message.ts1))
        return messages

    def send_odometry(self, t_ns: int, pose: FrdPose, resets: int, quality: int = UNKNOWN) -> None:
        """Send ODOMETRY in MAV_FRAME_LOCAL_FRD, with the velocity in MAV_FRAME_BODY_FRD."""
        m = self._mavlink
        message = m.MAVLink_odometry_message(
            t_ns // 1000,
            m.MAV_FRAME_LOCAL_FRD,
            m.MAV_FRAME_BODY_FRD,
            *pose.position.tolist(),
            wxyz_from_rotation(pose.rotation).tolist(),
            *pose.twist.ravel().tolist(),
            upper_triangle(pose.pose_covariance),
            upper_triangle(pose.twist_covariance),
            resets,
            m.MAV_ESTIMATOR_TYPE_MOCAP,
            quality,
        )
        self._send(message)

    def send_vision(self, t_ns: int, pose: FrdPose, resets: int) -> None:
        """Send VISION_POSITION_ESTIMATE, which has no velocity."""
        angles = roll_pitch_yaw(pose.rotation)
        message = self._mavlink.MAVLink_vision_position_estimate_message(
            t_ns // 1000, *pose.position.tolist(), *angles, upper_triangle(pose.pose_covariance), resets
        )
        self._send(message)

    def _parse(self, data: bytes) -> list[Any]:
        try:
            return self._encoder.parse_buffer(data) or []
        except self._mavlink.MAVError:
            self.faults["datagrams that are not MAVLink"] += 1
            return []

    def _send(self, message: Any) -> None:
        try:
            self._socket.send(message.pack(self._encoder))
            self._encoder.seq = (self._encoder.seq + 1) % 256
        except OSError:  # nothing listens there, or the network is down: the next one may arrive
            self.faults["messages that could not be sent"] += 1


class MavlinkBridge:
    """Passes one robot's poses to an autopilot.

    Args:
        vehicle: the autopilot.
        frames: MAVLink's frames in the arena.
        rate: of the poses that are sent.
        kind: the message.

    Attributes:
        check: is given what is sent and what the autopilot estimates, unless it is None.
    """

    def __init__(
        self,
        vehicle: MavlinkVehicle,
        frames: FrdFrames,
        rate: RateDivider,
        kind: Literal["odometry", "vision"] = "odometry",
    ) -> None:
        self.resets = ResetCounter()
        self.check: AutopilotCheck | None = None
        self._vehicle, self._frames, self._rate = vehicle, frames, rate
        self._kind = kind
        self._last: RobotPose | None = None  # that was sent
        self._is_lost = False

    def step(self, poses: PoseQueue, clock: ServerTimeReader) -> None:
        """Wait for poses and requests, at most `WAIT_S`, and pass them on."""
        select.select([poses, self._vehicle], [], [], WAIT_S)
        now_ns = clock.now_ns()
        for message in self._vehicle.answer(now_ns):
            if self.check is not None and now_ns is not None:
                self.check.add_message(now_ns, message)
        for pose in poses.take():
            if pose.state == "lost":
                self._lose(pose.t_ns)
            else:
                self._pass_on(pose)
        is_due = self._vehicle.beat(
            "STANDBY" if self._last is None else "CRITICAL" if self._is_lost else "ACTIVE"
        )
        if is_due and self._is_lost:  # again: UDP may have lost it
            self._send_failure(clock.now_ns())

    def _pass_on(self, pose: RobotPose) -> None:
        self.resets.add_pose(pose)
        if not self._rate.passes(pose.t_ns):
            return
        self._last, self._is_lost = pose, False
        send = self._vehicle.send_odometry if self._kind == "odometry" else self._vehicle.send_vision
        converted = self._frames.convert(pose)
        send(pose.t_ns, converted, self.resets.count)
        if self.check is not None:
            self.check.add_sent(pose.t_ns, converted)

    def _lose(self, t_ns: int) -> None:
        self.resets.add_loss()
        if self._last is not None and not self._is_lost:
            self._is_lost = True
            self._send_failure(t_ns)

    def _send_failure(self, t_ns: int | None) -> None:
        """Say that there is no odometry; VISION_POSITION_ESTIMATE has no field for it, and just stops."""
        if self._kind == "odometry" and self._last is not None and t_ns is not None:
            self._vehicle.send_odometry(t_ns, self._frames.convert(self._last), self.resets.count, FAILED)


def connect(to: str) -> socket.socket:
    """A UDP socket that sends to `udp:HOST:PORT` and receives from there only.

    Raises:
        ConfigError: the address is not of this form.
        NetworkError: the host is not known.
    """
    match = ADDRESS.fullmatch(to)
    if match is None or not 0 < int(match["port"]) < 1 << 16:
        raise ConfigError(f"--to {to} is no address; give udp:HOST:PORT, such as udp:192.168.4.1:14540")
    try:
        family, kind, _, _, address = socket.getaddrinfo(
            match["host"].strip("[]"), int(match["port"]), type=socket.SOCK_DGRAM
        )[0]
    except OSError as error:
        raise NetworkError(f"--to {to}: the host is not known ({error.strerror}); check its name") from None
    connection = socket.socket(family, kind)
    connection.connect(address)
    connection.setblocking(False)
    return connection
