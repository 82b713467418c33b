# SPDX-License-Identifier: BSD-3-Clause
"""What a program may ask of a running server."""

import time

import zenoh

from calib.rig.messages import RigMessage
from calib.rig.rig import Rig
from camera_node.errors import NetworkError
from camera_node.protocol.messages import MessageError, decode, encode
from fusion.errors import FusionError
from fusion.model.robots import Robot
from fusion.protocol.messages import Robots, RobotsRequest, robots_key, undo_key

ASK_S = 5.0
AGAIN_S = 0.1


def change_robots(
    session: zenoh.Session, arena: str, request: RobotsRequest, timeout_s: float = ASK_S
) -> dict[str, Robot]:
    """Rename, remove and define robots, all of it or nothing; the robots that the server looks for then.

    Raises:
        FusionError: the request makes no sense; the server's own words.
        NetworkError: no server answers in time.
    """
    answer = _ask(session, arena, robots_key(arena), encode(request), timeout_s)
    try:
        return decode(answer, Robots).robots
    except MessageError as error:
        raise NetworkError(f"the server's answer is no list of robots: {error}") from None


def undo_correction(session: zenoh.Session, arena: str, timeout_s: float = ASK_S) -> Rig:
    """Put the camera whose pose the server corrected last back where it stood; the rig in force then.

    Raises:
        FusionError: there is nothing to undo; the server's own words.
        NetworkError: no server answers in time.
    """
    answer = _ask(session, arena, undo_key(arena), b"", timeout_s)
    try:
        return decode(answer, RigMessage).rig()
    except MessageError as error:
        raise NetworkError(f"the server's answer is no rig: {error}") from None


def _ask(session: zenoh.Session, arena: str, key: str, payload: bytes, timeout_s: float) -> bytes:
    end = time.monotonic() + timeout_s
    while (left := end - time.monotonic()) > 0:
        for reply in session.get(key, payload=payload, timeout=left):
            if reply.ok is not None:
                return reply.ok.payload.to_bytes()
            raise FusionError(reply.err.payload.to_string() if reply.err else "the server refused")
        time.sleep(min(AGAIN_S, left))  # a session that has just been opened knows nobody whom it could ask
    raise NetworkError(
        f"no server of arena '{arena}' answers within {timeout_s:g} s; is python -m fusion running there?"
    )
