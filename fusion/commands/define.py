# SPDX-License-Identifier: BSD-3-Clause
"""`fusion define`: measures a robot in the arena, and defines it in the running server."""

from pathlib import Path
from typing import Annotated, Literal

import tyro

from camera_node.foundation.errors import ConfigError
from camera_node.foundation.terminal import say
from camera_node.protocol.session import open_client
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
    connect: tuple[str, ...] = ("tcp/127.0.0.1:7447",),
    arena: str = "arena",
    zenoh_config: Annotated[Path | None, tyro.conf.arg(name="zenoh")] = None,
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
        connect: the server's Zenoh endpoints.
        arena: the arena's name.
        zenoh_config: a Zenoh configuration (JSON5) for TLS, access control or scouting.
    """
    definition = RobotDefinition(name, diameter, motion, at, within, replace)
    if not 0 < seconds < 3600:
        raise ConfigError(f"--seconds is {seconds:g}; it must be above 0 and below 3600")
    with open_client(connect, zenoh_config) as session:
        robots = define_robot(session, arena, definition, seconds)
    say(describe(name, robots))
    return 0
