# SPDX-License-Identifier: BSD-3-Clause
"""`fusion define`: a robot that stands in the arena becomes one that the server looks for."""

from itertools import combinations
from pathlib import Path
from typing import Annotated, Literal

import msgspec
import tyro

from camera_node.config import is_name
from camera_node.errors import ConfigError
from camera_node.protocol.session import open_client
from fusion.client.measure import find_standing, robot_of, watch
from fusion.model.robots import Robot, distances
from fusion.protocol.messages import RobotsRequest
from fusion.protocol.requests import change_robots


def define(
    name: str,
    /,
    *,
    diameter: float,
    at: tuple[float, float, float] | None = None,
    within: float = 0.3,
    motion: Literal["ground", "aerial"] = "aerial",
    seconds: float = 2.0,
    connect: tuple[str, ...] = ("tcp/127.0.0.1:7447",),
    arena: str = "arena",
    zenoh_config: Annotated[Path | None, tyro.conf.arg(name="zenoh")] = None,
) -> int:
    """Measure a robot's markers where it stands, and have the running server look for it.

    All its markers must be seen by two cameras or more, and belong to no other robot.

    Args:
        name: the robot's name.
        diameter: of its roundels' black discs, d_o, metres.
        at: roughly where it stands, world, metres; without it every marker of no robot is its own.
        within: its markers are no further than this from there, metres.
        motion: how it moves.
        seconds: how long to look.
        connect: the server's Zenoh endpoints.
        arena: the arena's name.
        zenoh_config: a Zenoh configuration (JSON5) for TLS, access control or scouting.
    """
    if not is_name(name):
        raise ConfigError(f"'{name}' can't name a robot; use letters, digits, - and _")
    if not 0 < seconds < 3600:
        raise ConfigError(f"--seconds is {seconds:g}; it must be above 0, and below an hour")
    with open_client(connect, zenoh_config) as session:
        change_robots(session, arena, RobotsRequest())  # says whether a server is there, before anybody waits
        markers = find_standing(watch(session, arena, seconds))
        robot = robot_of(markers.within(at, within) if at else markers, diameter, motion)
        change_robots(session, arena, RobotsRequest(define={name: robot}))
    print(describe(name, robot))
    return 0


def describe(name: str, robot: Robot) -> str:
    """What was measured, in words, and as an entry for robots.yaml."""
    D = distances(robot.points)
    apart = ", ".join(f"{i}-{j} {D[i, j] * 1e3:.1f}" for i, j in combinations(range(len(D)), 2))
    said = f"the server looks for {name}, of {len(D)} marker{'s' * (len(D) > 1)}"
    entry = msgspec.json.encode({name: robot}).decode()[1:-1].replace('":', '": ').replace(",", ", ")
    return f"{said}{f' ({apart} mm apart)' if apart else ''}; for robots.yaml:\n  {entry}"
