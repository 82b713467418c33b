# SPDX-License-Identifier: BSD-3-Clause
"""`roundel mavlink`: one robot's poses to its autopilot."""

import math
import time
from dataclasses import dataclass
from typing import Annotated, Literal

import tyro

from camera_node.foundation.config import require_name
from camera_node.foundation.service import stopped_by_signals
from camera_node.foundation.terminal import say
from camera_node.protocol.server_connection import LOCAL_SERVER, ConnectionOptions
from fusion.bridges.mavlink_check import AutopilotCheck
from fusion.bridges.mavlink_frames import FrdFrames
from fusion.bridges.mavlink_vehicle import MavlinkBridge, MavlinkVehicle, RateDivider
from fusion.bridges.pose_queue import log_faults, receive_poses


@dataclass(frozen=True)
class VehicleOptions:
    """The vehicle, and MAVLink's frames in the arena."""

    origin_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """The local frame's origin in the arena's world, metres."""
    heading_deg: float = 0.0
    """The direction of the local frame's x axis in the arena's world, degrees from x towards y."""
    forward_deg: float = 0.0
    """The direction of the vehicle's nose in the robot's body, degrees from x towards y."""
    system: int = 1
    """MAVLink's number of the vehicle."""


DEFAULTS = VehicleOptions()


def mavlink(
    robot: tyro.conf.Positional[str],
    *,
    to: str,
    connection: ConnectionOptions = LOCAL_SERVER,
    message: Literal["odometry", "vision"] = "odometry",
    rate_hz: float = 50.0,
    check_s: float | None = None,
    vehicle: Annotated[VehicleOptions, tyro.conf.arg(name="")] = DEFAULTS,
) -> int:
    """Send a robot's poses to its autopilot (PX4, ArduPilot) over MAVLink, until stopped.

    Args:
        robot: its name in the arena.
        to: the autopilot or a MAVLink router, as udp:HOST:PORT.
        connection: the arena's server.
        message: odometry has velocity; vision is VISION_POSITION_ESTIMATE.
        rate_hz: messages a second at most.
        check_s: compare for so long what the autopilot estimates with what it is sent, while the vehicle is carried
            about; print whether frames, yaw and delay agree, and end.
        vehicle: its number, and where MAVLink's frames are in the arena.
    """
    require_name(robot, "a robot")
    converter = FrdFrames(vehicle.origin_m, vehicle.heading_deg, vehicle.forward_deg)
    rate = RateDivider(rate_hz)
    with (
        stopped_by_signals() as stop,
        MavlinkVehicle(to, vehicle.system) as autopilot,
        receive_poses(connection, robot) as poses,
    ):
        bridge = MavlinkBridge(autopilot, converter, rate, message)
        poses.client.status().on_message(bridge.resets.add_status)
        if poses.client.connection.wait_unless(stop) is None:
            return 0
        say(f"MAVLink: '{robot}' to {to}")
        bridge.check = None if check_s is None else AutopilotCheck()
        end_s = math.inf if check_s is None else time.monotonic() + check_s
        while not stop.is_set() and time.monotonic() < end_s:
            bridge.step(poses, poses.client.time)
        log_faults(autopilot.faults)
    return 0 if bridge.check is None else report(bridge.check)


def report(check: AutopilotCheck) -> int:
    """Print what was found; 0 if all is in order, else 1."""
    found = list(check.lines())
    for is_good, text in found:
        say(f"{'ok' if is_good else 'wrong':6}{text}")
    return 0 if all(is_good for is_good, _ in found) else 1
