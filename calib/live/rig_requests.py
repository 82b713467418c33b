# SPDX-License-Identifier: BSD-3-Clause
"""Requests to the server to change the rig in force. The server validates, applies and saves it, or refuses."""

import time

import zenoh

from calib.rig.rig import Rig
from calib.rig.rig_messages import (
    RigHistory,
    RigMessage,
    RigRequest,
    RigStepRequest,
    redo_rig_key,
    rig_history_key,
    set_rig_key,
    undo_rig_key,
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


def undo_rig(
    session: zenoh.Session,
    arena: str,
    program: str,
    timeout_s: float = REQUEST_S,
    rig_t_ns: int | None = None,
) -> RigMessage:
    """Have the server undo the last change of its rig; returns and raises as `set_rig`.

    `rig_t_ns` as in `RigStepRequest`.
    """
    return _request_step(session, undo_rig_key(arena), program, timeout_s, rig_t_ns)


def redo_rig(
    session: zenoh.Session,
    arena: str,
    program: str,
    timeout_s: float = REQUEST_S,
    rig_t_ns: int | None = None,
) -> RigMessage:
    """Have the server redo the change of its rig that was undone last; returns and raises as `set_rig`.

    `rig_t_ns` as in `RigStepRequest`.
    """
    return _request_step(session, redo_rig_key(arena), program, timeout_s, rig_t_ns)


def _request_step(
    session: zenoh.Session, key: str, program: str, timeout_s: float, rig_t_ns: int | None
) -> RigMessage:
    request = RigStepRequest(source=RequestSource.of(program), rig_t_ns=rig_t_ns)
    return _read(send_request(session, key, encode(request), timeout_s))


def request_rig_history(session: zenoh.Session, arena: str, timeout_s: float = REQUEST_S) -> RigHistory:
    """All versions of the server's rig.

    Raises:
        RequestError: the server can't read them.
        NetworkError: no server answers in time, or with something else.
    """
    data = send_request(session, rig_history_key(arena), timeout_s=timeout_s)
    try:
        return decode(data, RigHistory)
    except MessageError as error:
        raise NetworkError(f"the server's reply is no history: {error}; {OTHER_VERSION}") from None


def request_rig(session: zenoh.Session, arena: str, timeout_s: float = REQUEST_S) -> Rig | None:
    """The rig in force; returns None and raises as `request_rig_message`."""
    data = request_rig_message(session, arena, timeout_s)
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
