# SPDX-License-Identifier: BSD-3-Clause
"""Finds out why no pose arrives: a misspelt name is not a missing server."""

import difflib
from collections.abc import Collection

import zenoh

from camera_node.foundation.config import is_name
from camera_node.foundation.errors import NetworkError
from camera_node.protocol.connection import ServerConnection
from camera_node.protocol.discovery import ALIVE
from fusion.protocol.robot_requests import request_robots

ANSWER_S = 1.0  # longest wait for each answer
MAX_NAMED = 20  # robots or arenas in one line
NO_SERVER = "is roundel server running there?"


def cause_of_silence(connection: ServerConnection, arena: str, robot: str | None = None) -> str:
    """The likely cause, with what to do; asks the server, and takes `ANSWER_S` for each of two questions at most.

    Args:
        connection: to the server.
        arena: from which poses are expected.
        robot: of which they are expected; None for all.
    """
    try:
        session = connection.session(0.0)
        if arena not in (present := _arenas(session)):
            return _other_arenas(present) if present else NO_SERVER
        known = sorted(request_robots(session, arena, ANSWER_S).robots)
    except (NetworkError, zenoh.ZError):
        return NO_SERVER
    if robot is not None and robot not in known:
        return no_such_robot(robot, known)
    return f"the server runs, and its robots are {_listed(known)}; do its cameras run?"


def no_such_robot(name: str, known: Collection[str]) -> str:
    """That an arena has other robots, and the one that was probably meant."""
    similar = difflib.get_close_matches(name, known, 1)
    hint = f"; did you mean {similar[0]}?" if similar else ""
    return f"the arena has no such robot, but {_listed(known)}{hint}"


def _arenas(session: zenoh.Session) -> list[str]:
    """The arenas whose servers this one reaches."""
    replies = session.liveliness().get(ALIVE, timeout=ANSWER_S)
    names = {str(reply.ok.key_expr).partition("/")[0] for reply in replies if reply.ok is not None}
    return sorted(name for name in names if is_name(name))


def _other_arenas(present: list[str]) -> str:
    option = f"give --arena {present[0]}" if len(present) == 1 else "choose one with --arena"
    return f"the arena there is {_listed(present)}: {option}"


def _listed(names: Collection[str]) -> str:
    return ", ".join(sorted(names)[:MAX_NAMED]) or "none"
