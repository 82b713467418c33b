# SPDX-License-Identifier: BSD-3-Clause
"""What may be asked of the server: to change robots, to take back a camera's correction.

Zenoh calls back on its own threads; the server's thread does the work and replies.
"""

from collections.abc import Callable

import msgspec
import zenoh

from camera_node.errors import RoundelError
from camera_node.messages import MessageError, decode, encode
from fusion.errors import FusionError
from fusion.messages import Robots, RobotsRequest

MAX_PAYLOAD = 1 << 20


def parse_robots(payload: bytes) -> RobotsRequest:
    """The change that a request asks for, in MessagePack or, starting with `{`, in JSON; none without payload.

    Raises:
        FusionError: it is neither, or says what no robot has.
    """
    if len(payload) > MAX_PAYLOAD:
        raise FusionError(f"{len(payload)} bytes are no robots")
    if not payload:
        return RobotsRequest()
    try:
        if _is_json(payload):
            return msgspec.json.decode(payload, type=RobotsRequest)
        return decode(payload, RobotsRequest)
    except (msgspec.DecodeError, MessageError, RecursionError) as error:
        raise FusionError(f"no request for robots: {error}") from None


def robots_reply(payload: bytes, robots: Robots) -> bytes:
    """The robots in the encoding in which they were asked for."""
    return msgspec.json.encode(robots) if _is_json(payload) else encode(robots)


def respond(query: zenoh.Query, answer: Callable[[bytes], bytes]) -> None:
    """Reply with what `answer` makes of the payload; what it refuses goes back as an error of one line."""
    with query:
        try:
            reply = answer(query.payload.to_bytes() if query.payload else b"")
        except RoundelError as error:
            query.reply_err(str(error))
        else:
            query.reply(query.key_expr, reply)


def _is_json(payload: bytes) -> bool:
    return payload.lstrip()[:1] == b"{"
