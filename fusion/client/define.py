# SPDX-License-Identifier: BSD-3-Clause
"""Defines a robot in a running server from the markers of a stationary one."""

from dataclasses import dataclass
from itertools import combinations
from typing import Literal

import msgspec
import zenoh

from camera_node.foundation.config import require_name
from camera_node.foundation.errors import ConfigError
from camera_node.protocol.requests import RequestSource
from fusion.client.measure import collect_markers, find_stationary_markers, robot_from_markers
from fusion.model.likeness import distances
from fusion.protocol.pose_messages import Robots, RobotsRequest
from fusion.protocol.robot_requests import change_robots, request_robots

LOST_AT_RESTART = "a restart of the server loses it, because arena.yaml names no saved_robots"


@dataclass(frozen=True)
class RobotDefinition:
    """What the user specifies about a robot.

    Attributes:
        name: the robot's name.
        diameter_m: of its roundels' black discs.
        motion: how it moves.
        centre: its rough position, world, metres; None if it has all unlabeled markers.
        radius_m: the largest distance of its markers from there.
        replace: whether it may replace a robot of that name.

    Raises:
        ConfigError: the name can't be one.
    """

    name: str
    diameter_m: float
    motion: Literal["ground", "aerial"] = "aerial"
    centre: tuple[float, float, float] | None = None
    radius_m: float = 0.3
    replace: bool = False

    def __post_init__(self) -> None:
        require_name(self.name, "a robot")


def define_robot(session: zenoh.Session, arena: str, definition: RobotDefinition, seconds: float) -> Robots:
    """Measure a robot for `seconds`, and add it to the robots of the running server, which it returns.

    Raises:
        ConfigError: there is a robot of that name.
        FusionError: the markers make no robot, or the server refuses it.
        NetworkError: no server answers in time.
    """
    existing = request_robots(session, arena).robots  # fails without a server, before the measurement
    if definition.name in existing and not definition.replace:
        raise ConfigError(f"there is another robot '{definition.name}': add --replace, or use another name")
    markers = find_stationary_markers(collect_markers(session, arena, seconds))
    if definition.centre is not None:
        markers = markers.within(definition.centre, definition.radius_m)
    robot = robot_from_markers(markers, definition.diameter_m, definition.motion)
    source = RequestSource.of("fusion define")
    request = RobotsRequest(define={definition.name: robot}, replace=definition.replace, source=source)
    return change_robots(session, arena, request)


def describe(name: str, robots: Robots) -> str:
    """The measured robot in words, and as an entry for robots.yaml."""
    robot = robots.robots[name]
    D = distances(robot.points)
    pairs = ", ".join(f"{i}-{j} {D[i, j] * 1e3:.1f}" for i, j in combinations(range(len(D)), 2))
    defined = f"the server now tracks {name}, with {len(D)} marker{'s' * (len(D) > 1)}"
    entry = msgspec.json.encode({name: robot}).decode()[1:-1].replace('":', '": ').replace(",", ", ")
    lost = f"; {LOST_AT_RESTART}" if name in robots.unsaved else ""
    return f"{defined}{f' (distances in mm: {pairs})' if pairs else ''}{lost}; for robots.yaml:\n  {entry}"
