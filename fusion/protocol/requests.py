# SPDX-License-Identifier: BSD-3-Clause
"""Requests to a running server."""

import time

import zenoh

from calib.rig.messages import RigMessage
from calib.rig.rig import Rig
from camera_node.errors import NetworkError
from camera_node.protocol.messages import MessageError, decode, encode
from camera_node.protocol.requests import sender
from camera_node.protocol.session import reply_of_server
from fusion.errors import FusionError
from fusion.protocol.messages import Robots, RobotsRequest, robots_key, set_robots_key, undo_key

REQUEST_S = 5.0  # the timeout of a request
RETRY_S = 0.1


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
    return _robots_of(_request(session, arena, set_robots_key(arena), encode(request), timeout_s))


def request_robots(session: zenoh.Session, arena: str, timeout_s: float = REQUEST_S) -> Robots:
    """All robots that the server tracks, and those that a restart would lose.

    Raises:
        NetworkError: no server answers in time.
    """
    return _robots_of(_request(session, arena, robots_key(arena), b"", timeout_s))


def _robots_of(data: bytes) -> Robots:
    try:
        return decode(data, Robots)
    except MessageError as error:
        raise NetworkError(f"the server's reply is no list of robots: {error}") from None


def undo_correction(session: zenoh.Session, arena: str, timeout_s: float = REQUEST_S) -> Rig:
    """Undo the last recalibration of a moved camera by the server.

    Returns:
        The active rig after that.

    Raises:
        FusionError: there is nothing to undo; the message is the server's.
        NetworkError: no server answers in time.
    """
    data = _request(session, arena, undo_key(arena), b"", timeout_s)
    try:
        return decode(data, RigMessage).rig()
    except MessageError as error:
        raise NetworkError(f"the server's reply is no rig: {error}") from None


def _request(session: zenoh.Session, arena: str, key: str, payload: bytes, timeout_s: float) -> bytes:
    end = time.monotonic() + timeout_s
    while (left := end - time.monotonic()) > 0:
        every = zenoh.ConsolidationMode.NONE
        replies = session.get(
            key, payload=payload, attachment=sender(session), consolidation=every, timeout=left
        )
        if reply := reply_of_server(session, replies):
            if reply.ok is not None:
                return reply.ok.payload.to_bytes()
            raise FusionError(reply.err.payload.to_string() if reply.err else "the server refused")
        time.sleep(min(RETRY_S, left))  # a session that was just opened knows no queryable yet
    raise NetworkError(
        f"no server of arena '{arena}' answers within {timeout_s:g} s; is python -m fusion running there?"
    )
