# SPDX-License-Identifier: BSD-3-Clause
"""Parses the requests in Zenoh queries and sends the replies. An invalid request gets an error reply of one line."""

import logging
import re
from collections.abc import Callable
from typing import TypeVar

import cv2
import msgspec
import zenoh

from camera_node.arrays import Grey
from camera_node.errors import RoundelError
from camera_node.protocol.messages import MessageError, decode, encode

log = logging.getLogger("camera_node.requests")

QUALITY = 85  # JPEG quality unless the request gives one
MAX_PAYLOAD = 1 << 20  # bytes
T = TypeVar("T", bound=msgspec.Struct)


class RequestError(RoundelError):
    """An invalid request; the message goes to its sender."""


def sender(session: zenoh.Session) -> bytes:
    """The attachment of a request: the id of the session that sends it, for the receiver's audit."""
    return str(session.info.zid()).encode()


def sender_of(query: zenoh.Query) -> str:
    """The id of the session that a request claims to come from; empty where it claims none."""
    attachment = query.attachment.to_bytes() if query.attachment else b""
    return attachment.decode() if re.fullmatch(rb"[0-9a-f]{1,32}", attachment) else ""


def payload_of(query: zenoh.Query) -> bytes:
    """The payload of a query, empty where it has none."""
    return query.payload.to_bytes() if query.payload else b""


def parse_request(payload: bytes, kind: type[T]) -> T:
    """Decode a request: a map in MessagePack or, where it starts with `{`, in JSON.

    Raises:
        RequestError: the payload is neither, has an unknown field or has an invalid value.
    """
    if len(payload) > MAX_PAYLOAD:
        raise RequestError(f"{kind.__name__} of {len(payload)} bytes; send at most {MAX_PAYLOAD}")
    try:
        return decode(
            msgspec.msgpack.encode(msgspec.json.decode(payload)) if _is_json(payload) else payload, kind
        )
    except (msgspec.DecodeError, MessageError, RecursionError) as error:
        raise RequestError(f"invalid {kind.__name__}: {error}") from None


def encode_reply(payload: bytes, message: msgspec.Struct) -> bytes:
    """Encode a reply as its request was encoded: in JSON or MessagePack."""
    return msgspec.json.encode(message) if _is_json(payload) else encode(message)


def _is_json(payload: bytes) -> bool:
    return payload.lstrip()[:1] == b"{"


def respond(query: zenoh.Query, answer: Callable[[zenoh.Query], bytes]) -> bool:
    """Reply with the bytes that `answer` returns, or with its RoundelError as an error reply of one line.

    Returns:
        Whether `answer` succeeded.
    """
    with query:
        try:
            query.reply(query.key_expr, answer(query))
        except RoundelError as error:
            query.reply_err(str(error))
            return False
        except zenoh.ZError as error:
            log.debug("the reply could not be sent: %s", error)
    return True


def encode_jpeg(image: Grey, quality: int) -> bytes:
    """Encode an image, grey or BGR, as JPEG with a quality of 1 to 100."""
    ok, data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])
    if not ok:
        raise RequestError("the image could not be encoded as JPEG; try another quality")
    return data.tobytes()


def parse_draw(parameters: zenoh.Parameters) -> bool:
    """Whether a snapshot request asks for the roundels to be drawn: `draw` or `draw=1`."""
    return "draw" in parameters and parameters.get("draw") not in ("0", "false")


def parse_quality(parameters: zenoh.Parameters) -> int:
    """The JPEG quality of a snapshot request."""
    text = parameters.get("quality") or str(QUALITY)
    if not (text.isdecimal() and len(text) < 4 and 1 <= int(text) <= 100):
        raise RequestError(f"quality={text}: give a number from 1 to 100")
    return int(text)
