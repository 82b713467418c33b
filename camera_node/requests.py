# SPDX-License-Identifier: BSD-3-Clause
"""What a camera node answers: its settings, and a picture. A bad request gets an error in reply, nothing else."""

import logging
import math
from collections.abc import Callable
from typing import Any

import cv2
import msgspec
import zenoh

from camera_node.errors import ConfigError
from camera_node.messages import MessageError, Settings, decode, encode
from camera_node.pixels import Grey

log = logging.getLogger("camera_node.requests")

QUALITY = 85  # of a JPEG
MAX_PAYLOAD = 65536


class RequestError(ValueError):
    """A request that makes no sense, told to whoever asked."""


def parse_settings(payload: bytes) -> Settings:
    """The settings that a request asks for, a map in MessagePack or, starting with `{`, in JSON.

    Raises:
        RequestError: the payload is neither, or names an unknown setting, or a value is impossible.
    """
    if len(payload) > MAX_PAYLOAD:
        raise RequestError(f"{len(payload)} bytes are no settings")
    try:
        if payload.lstrip()[:1] == b"{":
            settings = msgspec.json.decode(payload, type=Settings)
        else:
            settings = decode(payload, Settings)
    except (msgspec.DecodeError, MessageError, RecursionError) as error:
        raise RequestError(str(error)) from None
    if not all(x is None or math.isfinite(x) for x in (settings.exposure_us, settings.gain)):
        raise RequestError("settings must be finite")
    if settings.exposure_us is not None and not 0 < settings.exposure_us <= 1e7:
        raise RequestError(f"an exposure of {settings.exposure_us} us is not possible")
    return settings


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


def answering(
    answer: Callable[[zenoh.Query], bytes], refuse: Callable[[], None]
) -> Callable[[zenoh.Query], Any]:
    """A Zenoh callback that replies with what `answer` returns; errors of the request go back as error replies."""

    def respond(query: zenoh.Query) -> None:
        with query:
            try:
                query.reply(query.key_expr, answer(query))
            except (RequestError, ConfigError) as error:
                refuse()
                query.reply_err(str(error))
            except zenoh.ZError as error:
                log.debug("no reply: %s", error)

    return respond


def settings_reply(query: zenoh.Query, settings: Settings) -> bytes:
    """The settings in the encoding in which they were asked for."""
    payload = query.payload.to_bytes() if query.payload else b""
    return msgspec.json.encode(settings) if payload.lstrip()[:1] == b"{" else encode(settings)
