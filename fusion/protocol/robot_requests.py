# SPDX-License-Identifier: BSD-3-Clause
"""Requests to a running server."""

from collections.abc import Callable

import zenoh

from camera_node.foundation.errors import NetworkError, printable
from camera_node.protocol.messages import MessageError, decode, encode
from camera_node.protocol.requests import REQUEST_S, RequestError, RequestSource, send_request
from fusion.errors import FusionError
from fusion.model.robots import Robot
from fusion.protocol.pose_messages import Robots, RobotsRequest, robots_key, set_robots_key


def change_robots(
    session: zenoh.Session, arena: str, request: RobotsRequest, timeout_s: float = REQUEST_S
) -> Robots:
    """Rename, remove and define robots, all or none.

    Returns:
        All robots that the server tracks after the change, and those that a restart would lose.

    Raises:
        FusionError: the server refuses the request; the message is the server's.
        NetworkError: no server answers in time.
    """
    return _robots_of(_request(session, set_robots_key(arena), encode(request), timeout_s))


def request_robots(session: zenoh.Session, arena: str, timeout_s: float = REQUEST_S) -> Robots:
    """All robots that the server tracks, and those that a restart would lose.

    Raises:
        NetworkError: no server answers in time.
    """
    return _robots_of(_request(session, robots_key(arena), b"", timeout_s))


def reframe_robot(
    session: zenoh.Session,
    arena: str,
    name: str,
    change: Callable[[Robot], Robot],
    program: str,
    timeout_s: float = REQUEST_S,
) -> Robots:
    """Replace a robot by `change` of it, such as `fusion.model.robots.move_origin`; it is acquired again.

    `program` asks for it, such as "roundel robots turn", for the server's audit.

    Raises:
        FusionError: there is no such robot, or it can not be changed so.
        NetworkError: no server answers in time.
    """
    robots = request_robots(session, arena, timeout_s).robots
    if name not in robots:
        raise FusionError(
            f"there is no robot '{printable(name, 80)}'; there are {', '.join(robots) or 'none'}"
        )
    changed, source = {name: change(robots[name])}, RequestSource.of(program)
    request = RobotsRequest(define=changed, replace=True, source=source)
    return change_robots(session, arena, request, timeout_s)


def _robots_of(data: bytes) -> Robots:
    try:
        return decode(data, Robots)
    except MessageError as error:
        raise NetworkError(f"the server's reply is no list of robots: {error}") from None


def _request(session: zenoh.Session, key: str, payload: bytes, timeout_s: float) -> bytes:
    try:
        return send_request(session, key, payload, timeout_s)
    except RequestError as error:
        raise FusionError(str(error)) from None
