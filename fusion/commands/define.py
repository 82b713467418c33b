# SPDX-License-Identifier: BSD-3-Clause
"""`roundel define`: measures a robot in the arena, and defines it in the running server."""

from typing import Literal

from camera_node.foundation.errors import ConfigError
from camera_node.foundation.terminal import say
from camera_node.protocol.server_connection import LOCAL_SERVER, ConnectionOptions
from fusion.client.robot_definition import RobotDefinition, define_robot, describe


def define(
    name: str,
    /,
    *,
    diameter: float,
    at: tuple[float, float, float] | None = None,
    within: float = 0.3,
    motion: Literal["ground", "aerial"] = "aerial",
    seconds: float = 2.0,
    replace: bool = False,
    connection: ConnectionOptions = LOCAL_SERVER,
) -> int:
    """Measure the markers of a stationary robot, and add it to the robots of the running server.

    Two or more cameras must see all its markers, and the markers must belong to no other robot.

    Args:
        name: the robot's name.
        diameter: of its roundels' black discs, d_o, metres.
        at: its rough position, world, metres; without it the robot has all unlabeled markers.
        within: the largest distance of its markers from there, metres.
        motion: how it moves.
        seconds: the duration of the measurement.
        replace: replace the robot of that name; without it, a name in use is refused.
        connection: the arena's server.
    """
    definition = RobotDefinition(name, diameter, motion, at, within, replace)
    if not 0 < seconds < 3600:
        raise ConfigError(f"--seconds is {seconds:g}; it must be above 0 and below 3600")
    with connection.open() as session:
        robots = define_robot(session, connection.arena, definition, seconds)
    say(describe(name, robots))
    return 0
