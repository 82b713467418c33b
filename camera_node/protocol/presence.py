# SPDX-License-Identifier: BSD-3-Clause
"""Who is there, by liveliness tokens: arenas, of which each server declares one, and cameras. Errors name them, and the
name that was probably meant.
"""

import time
from collections.abc import Collection

import zenoh

from camera_node.foundation.config import is_name
from camera_node.foundation.errors import most_similar, printable
from camera_node.protocol.session import guarded

ALIVE = "*/fusion/alive"  # the tokens of all servers; `Keys.fusion_alive` is that of one arena
ANSWER_S = 1.0  # longest wait for tokens, which a router sends at once
MAX_NAMED = 20  # names in one line
MAX_KNOWN = 1024  # names of one kind; whoever may declare tokens can declare any number
NO_SERVER = (
    "no server answers there: start it with roundel up or roundel server, or correct the address (--connect)"
)
NO_ARENA = "a Zenoh router answers there, but no arena's server: start roundel server, or correct --connect"
SILENT = "it runs but does not answer: see its log, or this program lacks the right to ask it"
NO_CAMERA = "no camera runs: start roundel camera on its machine"


class Presence:
    """The arenas that a session reaches, and the cameras of one arena, kept up to date once `watch` was called.

    Args:
        arena: its name.
        cameras: the key of the tokens of its cameras, `Keys.camera_alive`.
    """

    def __init__(self, arena: str, cameras: str) -> None:
        self._arena, self._cameras, self._opened_s = arena, cameras, 0.0
        self._session: zenoh.Session | None = None
        self._names = {ALIVE: frozenset[str](), cameras: frozenset[str]()}

    @property
    def arenas(self) -> frozenset[str]:
        """The arenas whose servers run."""
        return self._names[ALIVE]

    @property
    def cameras(self) -> frozenset[str]:
        """The cameras of the arena whose programs run."""
        return self._names[self._cameras]

    def why_no_server(self) -> str:
        """Why the arena's server does not answer, and what to do; empty if it is there."""
        if self._session is None:
            return NO_SERVER
        if not self.arenas and time.monotonic() - self._opened_s < ANSWER_S:
            return "the connection has just been opened: wait longer"
        return _why_no_server(self._session, self._arena, self.arenas)

    def watch(self, session: zenoh.Session) -> None:
        """Subscribe to the tokens, once the session is open."""
        self._session, self._opened_s = session, time.monotonic()
        for key, number in ((ALIVE, 0), (self._cameras, 2)):
            self._watch_key(session, key, number)

    def _watch_key(self, session: zenoh.Session, key: str, number: int) -> None:
        def receive(sample: zenoh.Sample) -> None:
            name, known = str(sample.key_expr).split("/")[number], self._names[key]
            if sample.kind == zenoh.SampleKind.DELETE:
                self._names[key] = known - {name}
            elif is_name(name) and len(known) < MAX_KNOWN:
                self._names[key] = known | {name}

        session.liveliness().declare_subscriber(key, guarded("a liveliness token", receive), history=True)


def why_no_server(session: zenoh.Session, arena: str) -> str:
    """As `Presence.why_no_server`, asked now; takes `ANSWER_S` at most."""
    return _why_no_server(session, arena, _ask(session, ALIVE, 0))


def why_no_camera(session: zenoh.Session, key: str, camera: str) -> str:
    """Why a camera does not answer, and what to do; empty if its program runs.

    `key` is that of the tokens of the arena's cameras. It takes `ANSWER_S` at most for each of two questions.
    """
    cameras = _ask(session, key, 2)
    if camera in cameras:
        return ""
    return (
        no_such("camera", camera, cameras)
        if cameras
        else why_no_server(session, key.partition("/")[0]) or NO_CAMERA
    )


def no_such(kind: str, name: str, known: Collection[str]) -> str:
    """That a name does not exist, those that do, and the one that was probably meant."""
    similar = most_similar(name, known)
    hint = f"; did you mean {similar}?" if similar else ""
    return f"there is no {kind} '{printable(name, 80)}', but {listed(known)}{hint}"


def no_such_arena(arena: str, known: Collection[str]) -> str:
    """As `no_such`, and how an arena is chosen."""
    if len(known) > 1:
        return f"{no_such('arena', arena, known)}; choose with --arena (arena= in Python)"
    only = listed(known)
    return f'{no_such("arena", arena, known)}; give --arena {only} (arena="{only}" in Python)'


def listed(names: Collection[str]) -> str:
    """The first names of many, in alphabetical order."""
    more = f" and {len(names) - MAX_NAMED} more" if len(names) > MAX_NAMED else ""
    return (", ".join(sorted(names)[:MAX_NAMED]) or "none") + more


def _why_no_server(session: zenoh.Session, arena: str, arenas: Collection[str]) -> str:
    if arena in arenas:
        return ""
    if arenas:
        return no_such_arena(arena, arenas)
    return NO_ARENA if not session.is_closed() and session.info.routers_zid() else NO_SERVER


def _ask(session: zenoh.Session, key: str, number: int) -> frozenset[str]:
    """The names of part `number` of the tokens on a key; none from a session that is closed."""
    try:
        replies = session.liveliness().get(key, timeout=ANSWER_S)
        names = {str(reply.ok.key_expr).split("/")[number] for reply in replies if reply.ok is not None}
    except zenoh.ZError:
        return frozenset()
    return frozenset(sorted(name for name in names if is_name(name))[:MAX_KNOWN])
