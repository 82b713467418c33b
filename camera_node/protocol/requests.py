# SPDX-License-Identifier: BSD-3-Clause
"""How queries are answered, and what a camera node is asked for: its settings, and a picture.

A bad request gets an error in reply, nothing else.
"""

import logging
from collections.abc import Callable
from typing import TypeVar

import cv2
import msgspec
import zenoh

from camera_node.arrays import Grey
from camera_node.errors import RoundelError
from camera_node.protocol.messages import MessageError, decode, encode

log = logging.getLogger("camera_node.requests")

QUALITY = 85  # of a JPEG
MAX_PAYLOAD = 1 << 20
T = TypeVar("T", bound=msgspec.Struct)


class RequestError(RoundelError):
    """A request that makes no sense, told to whoever asked."""


def payload_of(query: zenoh.Query) -> bytes:
    """What came with a query, or nothing."""
    return query.payload.to_bytes() if query.payload else b""


def parse_request(payload: bytes, kind: type[T]) -> T:
    """What a request asks for: a map in MessagePack or, starting with `{`, in JSON.

    Raises:
        RequestError: the payload is neither, names what is unknown, or asks for what is impossible.
    """
    if len(payload) > MAX_PAYLOAD:
        raise RequestError(f"{len(payload)} bytes are no {kind.__name__}")
    try:
        return decode(
            msgspec.msgpack.encode(msgspec.json.decode(payload)) if _is_json(payload) else payload, kind
        )
    except (msgspec.DecodeError, MessageError, RecursionError) as error:
        raise RequestError(f"no {kind.__name__}: {error}") from None


def encode_reply(payload: bytes, message: msgspec.Struct) -> bytes:
    """A message in the encoding in which it was asked for."""
    return msgspec.json.encode(message) if _is_json(payload) else encode(message)


def _is_json(payload: bytes) -> bool:
    return payload.lstrip()[:1] == b"{"


def respond(query: zenoh.Query, answer: Callable[[zenoh.Query], bytes]) -> bool:
    """Reply with what `answer` returns; a fault that the asker can mend goes back as an error of one line.

    Returns:
        Whether the request was granted.
    """
    with query:
        try:
            query.reply(query.key_expr, answer(query))
        except RoundelError as error:
            query.reply_err(str(error))
            return False
        except zenoh.ZError as error:
            log.debug("no reply: %s", error)
    return True


def encode_jpeg(image: Grey, quality: int) -> bytes:
    """A JPEG of an image, grey or BGR, at a quality of 1 to 100."""
    ok, data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])
    if not ok:
        raise RequestError("the picture could not be written as JPEG")
    return data.tobytes()


def parse_draw(parameters: zenoh.Parameters) -> bool:
    """Whether a snapshot's request asks for the roundels to be drawn: `draw`, or `draw=1`."""
    return "draw" in parameters and parameters.get("draw") not in ("0", "false")


def parse_quality(parameters: zenoh.Parameters) -> int:
    """The JPEG quality that a snapshot's request asks for."""
    text = parameters.get("quality") or str(QUALITY)
    if not (text.isdecimal() and len(text) < 4 and 1 <= int(text) <= 100):
        raise RequestError(f"quality={text}: give a number from 1 to 100")
    return int(text)
