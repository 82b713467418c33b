# SPDX-License-Identifier: BSD-3-Clause
"""Defines a robot in a running server from the markers of a stationary one."""

from dataclasses import dataclass
from itertools import combinations
from typing import Literal

import msgspec
import zenoh

from camera_node.config import require_name
from fusion.client.measure import collect_markers, find_stationary_markers, robot_from_markers
from fusion.model.robots import Robot, distances
from fusion.protocol.messages import RobotsRequest
from fusion.protocol.requests import change_robots, request_robots


@dataclass(frozen=True)
class RobotDefinition:
    """What the user specifies about a robot.

    Attributes:
        name: the robot's name.
        diameter_m: of its roundels' black discs.
        motion: how it moves.
        centre: its rough position, world, metres; None if it has all unlabeled markers.
        radius_m: the largest distance of its markers from there.

    Raises:
        ConfigError: the name can't be one.
    """

    name: str
    diameter_m: float
    motion: Literal["ground", "aerial"] = "aerial"
    centre: tuple[float, float, float] | None = None
    radius_m: float = 0.3

    def __post_init__(self) -> None:
        require_name(self.name, "a robot")


def define_robot(session: zenoh.Session, arena: str, definition: RobotDefinition, seconds: float) -> Robot:
    """Measure a robot for `seconds`, and add it to the robots of the running server.

    Raises:
        FusionError: the markers make no robot, or the server refuses it.
        NetworkError: no server answers in time.
    """
    request_robots(session, arena)  # fails without a server, before the measurement
    markers = find_stationary_markers(collect_markers(session, arena, seconds))
    if definition.centre is not None:
        markers = markers.within(definition.centre, definition.radius_m)
    robot = robot_from_markers(markers, definition.diameter_m, definition.motion)
    change_robots(session, arena, RobotsRequest(define={definition.name: robot}))
    return robot


def describe(name: str, robot: Robot) -> str:
    """The measured robot in words, and as an entry for robots.yaml."""
    D = distances(robot.points)
    pairs = ", ".join(f"{i}-{j} {D[i, j] * 1e3:.1f}" for i, j in combinations(range(len(D)), 2))
    defined = f"the server now tracks {name}, with {len(D)} marker{'s' * (len(D) > 1)}"
    entry = msgspec.json.encode({name: robot}).decode()[1:-1].replace('":', '": ').replace(",", ", ")
    return f"{defined}{f' (distances in mm: {pairs})' if pairs else ''}; for robots.yaml:\n  {entry}"
