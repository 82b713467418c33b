# SPDX-License-Identifier: BSD-3-Clause
"""`roundel robots`: lists, renames, removes, turns, moves the pivot of and saves the robots of the running server."""

from collections.abc import Callable
from pathlib import Path
from typing import Literal

import zenoh

from camera_node.foundation.config import require_arguments
from camera_node.foundation.errors import ConfigError
from camera_node.foundation.terminal import say
from camera_node.protocol.requests import RequestSource
from camera_node.protocol.server_connection import LOCAL_SERVER, ConnectionOptions
from fusion.client.robot_definition import LOST_AT_RESTART
from fusion.model.robots import Robot, move_origin, save_robots, turn_heading
from fusion.protocol.pose_messages import Robots, RobotsRequest
from fusion.protocol.robot_requests import change_robots, reframe_robot, request_robots

USES = {
    "list": "",
    "rename": "OLD NEW",
    "remove": "NAME...",
    "pivot": "NAME X Y Z",
    "turn": "NAME DEGREES",
    "save": "FILE",
}


def robots(
    action: Literal["list", "rename", "remove", "pivot", "turn", "save"] = "list",
    arguments: tuple[str, ...] = (),
    /,
    *,
    force: bool = False,
    connection: ConnectionOptions = LOCAL_SERVER,
) -> int:
    """List, rename or remove the robots of the running server, change their frames, or save them in a file.

    Args:
        action: list; rename OLD NEW; remove NAME...; pivot NAME X Y Z moves the robot's origin to a point of its
            present frame, metres; turn NAME DEGREES turns its x axis about its z axis; save FILE writes robots.yaml on
            this machine.
        arguments: as the action needs them.
        force: save overwrites the file.
        connection: the arena's server.
    """
    require_arguments("robots", action, arguments, USES[action])
    if action == "save" and Path(arguments[0]).exists() and not force:
        raise ConfigError(f"{arguments[0]} exists; add --force to overwrite it, or name another file")
    with connection.open() as session:
        after = _apply(session, connection.arena, action, arguments)
    if action == "save":
        save_robots(after.robots, Path(arguments[0]))
        say(f"wrote {len(after.robots)} robots to {arguments[0]}")
        return 0
    if not after.robots:
        say("no robot is declared; roundel define NAME measures one")
    for name, robot in after.robots.items():
        say(_line(name, robot, name in after.unsaved))
    for name in sorted(set(after.unsaved) - after.robots.keys()):
        say(
            f"{name}: removed; a restart of the server brings it back, because arena.yaml names no saved_robots"
        )
    return 0


def _apply(session: zenoh.Session, arena: str, action: str, arguments: tuple[str, ...]) -> Robots:
    program = f"roundel robots {action}"
    source = RequestSource.of(program)
    if action == "rename":
        names = {arguments[0]: arguments[1]}
        return change_robots(session, arena, RobotsRequest(rename=names, source=source))
    if action == "remove":
        return change_robots(session, arena, RobotsRequest(remove=arguments, source=source))
    if action in ("pivot", "turn"):
        name, numbers = arguments[0], _numbers(arguments[1:])
        change = _move(*numbers) if action == "pivot" else lambda robot: turn_heading(robot, *numbers)
        return reframe_robot(session, arena, name, change, program)
    return request_robots(session, arena)


def _move(x: float, y: float, z: float) -> Callable[[Robot], Robot]:
    return lambda robot: move_origin(robot, (x, y, z))


def _numbers(words: tuple[str, ...]) -> tuple[float, ...]:
    try:
        return tuple(map(float, words))
    except ValueError as error:
        raise ConfigError(f"{error}; give numbers, such as 0.05") from None


def _line(name: str, robot: Robot, is_unsaved: bool) -> str:
    n = len(robot.markers)
    size = f"{n} marker{'s' * (n > 1)} of {robot.diameter_m:g} m"
    return f"{name}: {size}{f'; {LOST_AT_RESTART}' if is_unsaved else ''}"
