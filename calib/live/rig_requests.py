# SPDX-License-Identifier: BSD-3-Clause
"""Requests to the server to change the rig in force. The server validates, applies and saves it, or refuses."""

import time

import zenoh

from calib.rig.file_history import Step
from calib.rig.rig import Rig
from calib.rig.rig_messages import (
    RigHistory,
    RigMessage,
    RigRequest,
    RigStepRequest,
    rig_history_key,
    rig_step_key,
    set_rig_key,
)
from camera_node.foundation.errors import NetworkError
from camera_node.protocol.messages import Keys, MessageError, decode, encode
from camera_node.protocol.requests import (
    REQUEST_S,
    RETRY_S,
    RequestSource,
    content_of,
    send_request,
)
from camera_node.protocol.session import ask_server

OTHER_VERSION = "is it of this version of Roundel?"


def set_rig(
    session: zenoh.Session, arena: str, rig: Rig, program: str, timeout_s: float = REQUEST_S
) -> RigMessage:
    """Have the server use a rig.

    Args:
        session, arena: where the server is reached.
        rig: the rig; its cameras may lack poses.
        program: the name of the program that asks, such as `roundel calibrate wand`; the server reports it.
        timeout_s: for a server to be found.

    Returns:
        The rig in force.

    Raises:
        RequestError: the server refuses it; the message is the server's.
        NetworkError: no server answers in time.
    """
    request = RigRequest(rig=rig, source=RequestSource.of(program))
    return _read(send_request(session, set_rig_key(arena), encode(request), timeout_s))


def step_rig(
    session: zenoh.Session,
    arena: str,
    step: Step,
    program: str,
    timeout_s: float = REQUEST_S,
    rig_t_ns: int | None = None,
) -> RigMessage:
    """Have the server undo the last change of its rig, or redo the one that was undone last; returns and raises as
    `set_rig`. `rig_t_ns` as in `RigStepRequest`."""
    request = RigStepRequest(source=RequestSource.of(program), rig_t_ns=rig_t_ns)
    return _read(send_request(session, rig_step_key(arena, step), encode(request), timeout_s))


def request_rig_history(session: zenoh.Session, arena: str) -> RigHistory:
    """All versions of the server's rig.

    Raises:
        RequestError: the server can't read them.
        NetworkError: no server answers in time, or with something else.
    """
    data = send_request(session, rig_history_key(arena))
    try:
        return decode(data, RigHistory)
    except MessageError as error:
        raise NetworkError(f"the server's reply is no history: {error}; {OTHER_VERSION}") from None


def request_rig(session: zenoh.Session, arena: str) -> Rig | None:
    """The rig in force; returns None and raises as `request_rig_message`."""
    data = request_rig_message(session, arena)
    return None if data is None else _read(data).rig


def request_rig_message(session: zenoh.Session, arena: str, timeout_s: float = REQUEST_S) -> bytes | None:
    """The encoded `RigMessage` of the server, in preference to answers of other programs.

    Requests that the server refuses, because all its clients together ask too often, are sent again.

    Returns:
        The message; None if the server has no rig, or does not answer in time.

    Raises:
        RequestError: the server refuses until the time is over.
        NetworkError: the session is closed.
    """
    end = time.monotonic() + timeout_s
    while reply := ask_server(session, Keys(arena).rig, max(end - time.monotonic(), RETRY_S)):
        if reply.ok is not None or time.monotonic() + RETRY_S > end:
            return content_of(reply)
        time.sleep(RETRY_S)
    return None


def _read(data: bytes) -> RigMessage:
    try:
        return decode(data, RigMessage)
    except MessageError as error:
        raise NetworkError(f"the server's reply is no rig: {error}; {OTHER_VERSION}") from None
