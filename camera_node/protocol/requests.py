# SPDX-License-Identifier: BSD-3-Clause
"""Sends requests as Zenoh queries; parses them and sends the replies. An invalid request gets an error reply of one
line."""

import getpass
import logging
import re
import socket
import time
from collections.abc import Callable
from typing import Annotated, TypeVar

import cv2
import msgspec
import zenoh

from camera_node.foundation.arrays import Grey
from camera_node.foundation.errors import NetworkError, RoundelError
from camera_node.protocol.messages import MAX_BYTES, decode, encode
from camera_node.protocol.presence import SILENT, why_no_server
from camera_node.protocol.session import ask_server

log = logging.getLogger("camera_node.requests")

QUALITY = 85  # JPEG quality unless the request gives one
MAX_PAYLOAD = 1 << 20  # bytes
REQUEST_S = 5.0  # for a program that answers to be found
ANSWER_S = 60.0  # for an answer: to a new rig a server computes tables of its lenses
RETRY_S = 0.1  # between two requests without an answer
MAX_SOURCE = 64  # characters of each part of a request's source
Part = Annotated[str, msgspec.Meta(max_length=MAX_SOURCE)]
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


class RequestSource(msgspec.Struct, frozen=True):
    """Who sent a request, by its own account: the program, its machine and its user. Empty where unknown."""

    program: Part = ""
    host: Part = ""
    user: Part = ""

    @classmethod
    def of(cls, program: str) -> "RequestSource":
        """This machine and user, with a program such as `roundel calibrate wand`."""
        try:
            user = getpass.getuser()
        except (KeyError, OSError):  # the user's number has no name
            user = ""
        return cls(program[:MAX_SOURCE], socket.gethostname()[:MAX_SOURCE], user[:MAX_SOURCE])

    def __str__(self) -> str:
        return f"{self.program or 'an unnamed program'} of {self.user or 'unknown'}@{self.host or 'unknown'}"


def send_request(
    session: zenoh.Session,
    key: str,
    payload: bytes = b"",
    timeout_s: float = REQUEST_S,
    answer_s: float = ANSWER_S,
) -> bytes:
    """Send a request until a program answers it.

    Args:
        session: an open session.
        key: of the queryable.
        payload: of the request.
        timeout_s: for a program to be found.
        answer_s: for the answer of a program that was found, which may run on a busy machine.

    Raises:
        RequestError: the request is refused; the message is the program's.
        NetworkError: no program answers in time, or the session is closed.
    """
    end = time.monotonic() + timeout_s
    while (left := end - time.monotonic()) > 0:
        if reply := ask_server(session, key, max(left, answer_s), payload, sender(session)):
            return content_of(reply)
        time.sleep(min(RETRY_S, left))  # a session that was just opened knows no queryable yet
    cause = why_no_server(session, key.partition("/")[0]) or SILENT
    raise NetworkError(f"no server answers on {key} within {timeout_s:g} s; {cause}")


def content_of(reply: zenoh.Reply) -> bytes:
    """The payload of a reply.

    Raises:
        RequestError: it refuses the request; the message is the program's.
    """
    if reply.ok is not None:
        return reply.ok.payload.to_bytes()
    raise RequestError(reply.err.payload.to_string() if reply.err else "the request was refused")


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
    except (msgspec.MsgspecError, ValueError, OverflowError, RecursionError) as error:
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
        except Exception as error:  # of a bug that this request shows: its sender learns of it at once
            log.exception("a request on %s failed", query.key_expr)
            query.reply_err(f"this request causes an internal error ({type(error).__name__}); see the log")
            return False
    return True


def encode_jpeg(image: Grey, quality: int, max_bytes: int = MAX_BYTES) -> bytes:
    """Encode an image, grey or BGR, as JPEG with a quality of 1 to 100, which is halved until the picture fits.

    Raises:
        RequestError: the image has no pixels or too many.
    """
    ok, data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])
    if ok and len(data) <= max_bytes:
        return data.tobytes()
    if quality == 1:
        raise RequestError(f"the picture has no JPEG of at most {max_bytes} bytes; use a lower resolution")
    return encode_jpeg(image, quality // 2, max_bytes)


def parse_flag(parameters: zenoh.Parameters, name: str) -> bool:
    """Whether a snapshot request has a flag such as `draw`: `draw` or `draw=1`."""
    return name in parameters and parameters.get(name) not in ("0", "false")


def parse_quality(parameters: zenoh.Parameters) -> int:
    """The JPEG quality of a snapshot request."""
    text = parameters.get("quality") or str(QUALITY)
    if not (text.isdecimal() and len(text) < 4 and 1 <= int(text) <= 100):
        raise RequestError(f"quality={text}: give a number from 1 to 100")
    return int(text)
