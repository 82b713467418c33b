# SPDX-License-Identifier: BSD-3-Clause
"""How programs reach the server of an arena: by its address or by scouting, and also before the server starts."""

import logging
import threading
import time
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from concurrent.futures import TimeoutError as FutureTimeout
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro
import zenoh
from zenoh import Session  # in a class with a field `zenoh`

from camera_node.foundation.config import require_name
from camera_node.foundation.errors import ConfigError, NetworkError
from camera_node.protocol.presence import ALIVE
from camera_node.protocol.session import NO_SERVER, PATIENCE_S, guarded, open_client, open_endless

log = logging.getLogger("camera_node.network")

FIRST_S = 0.5  # in which the session opens if the server runs, and invalid endpoints are found
WAIT_S = 0.2  # between two looks at whether a session is open
SCOUT_S = 1.5  # scouting repeats its question after 1 s
CONNECT_S = 2.0  # to one router that was found
MAX_ROUTERS = 16


class ServerConnection:
    """A Zenoh session that opens as soon as the server answers, and reconnects after every loss.

    A Zenoh client does not open while no router answers. Sessions in mode router open at once, but they sometimes stay
    without routes after an outage or beside another one that opens or closes (measured with 1.10, DECISIONS 35).

    Args:
        connect: endpoints of the server.
        zenoh_config: a file.
        send_buffer: of the kernel, bytes; `BURST_BUFFER` for a program that sends many messages at once, else None.

    Raises:
        NetworkError: an endpoint is invalid.
        ConfigError: the Zenoh configuration is missing or invalid.
    """

    def __init__(
        self, connect: Sequence[str], zenoh_config: Path | None = None, send_buffer: int | None = None
    ) -> None:
        connect = [str(endpoint) for endpoint in connect]  # a port alone is refused as any other text
        self.endpoints = " ".join(connect)
        self._future: Future[zenoh.Session] = Future()
        self._lock = threading.Lock()
        self._actions: list[Callable[[zenoh.Session], object]] = []
        self._closed = False
        arguments = connect, zenoh_config, send_buffer
        threading.Thread(target=self._open, args=arguments, daemon=True, name="open Zenoh session").start()
        self._opened_within(FIRST_S)

    def __enter__(self) -> "ServerConnection":
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the session, or do not open it."""
        with self._lock:
            self._closed = True
            self._actions.clear()
        if self._future.done() and self._future.exception() is None:
            self._future.result().close()

    def when_open(self, action: Callable[[zenoh.Session], object]) -> None:
        """Call `action` with the session: now if it is open, otherwise once it opens, on another thread.

        What an action raises on the other thread is logged.
        """
        with self._lock:
            if not self._future.done():
                self._actions.append(guarded("an action at the opening of the session", action))
                return
        if not self._closed:
            action(self._future.result())

    def session(self, timeout_s: float) -> zenoh.Session:
        """The open session.

        Raises:
            NetworkError: no server answers within `timeout_s`.
        """
        session = self._opened_within(timeout_s)
        if session is None:
            raise NetworkError(NO_SERVER.format(self.endpoints, timeout_s))
        return session

    def wait_unless(
        self, stop: threading.Event, on_wait: Callable[[], object] = lambda: None
    ) -> zenoh.Session | None:
        """Wait for the session, and log the server's absence once; None as soon as `stop` is set.

        Args:
            stop: ends the wait.
            on_wait: called again and again; its exceptions end the wait.
        """
        absence = _Absence(self.endpoints)
        while (session := self._opened_within(WAIT_S)) is None:
            if stop.is_set():
                return None
            on_wait()
            absence.report()
        absence.end()
        return session

    def _opened_within(self, timeout_s: float) -> zenoh.Session | None:
        try:
            return self._future.result(timeout_s)
        except FutureTimeout:
            return None

    def _open(self, connect: Sequence[str], zenoh_config: Path | None, send_buffer: int | None) -> None:
        try:
            session = open_endless(connect, zenoh_config, send_buffer)
        except (NetworkError, ConfigError) as error:
            self._future.set_exception(error)
            return
        while (actions := self._taken_actions(session)) is not None:
            for action in actions:
                action(session)
        if self._closed:
            session.close()

    def _taken_actions(self, session: zenoh.Session) -> list[Callable[[zenoh.Session], object]] | None:
        """The actions to call next; None, and the connection is open, once there are none."""
        with self._lock:
            taken, self._actions = self._actions, []
            if taken and not self._closed:
                return taken
            self._future.set_result(session)
            return None


class _Absence:
    """Logs once that no server answers, and once that one does."""

    def __init__(self, endpoints: str) -> None:
        self._endpoints, self._since_s, self._is_reported = endpoints, time.monotonic(), False

    def report(self) -> None:
        if self._is_reported or time.monotonic() - self._since_s < PATIENCE_S:
            return
        self._is_reported = True
        log.warning(
            "the server is away: none answers at %s; retrying. Check that it runs and that --connect is right",
            self._endpoints,
        )

    def end(self) -> None:
        if self._is_reported:
            log.warning("the server is back")


@dataclass(frozen=True, slots=True)
class FoundArena:
    """An arena, and the endpoints at which its server is reached."""

    arena: str
    endpoints: tuple[str, ...]


def find_arenas() -> list[FoundArena]:
    """The arenas whose servers answer multicast scouting; other Zenoh routers are left out."""
    found = []
    for endpoints in _scout():
        try:
            with open_client(endpoints, timeout_s=CONNECT_S) as session:
                replies = session.liveliness().get(ALIVE, timeout=CONNECT_S)
                tokens = [str(reply.ok.key_expr) for reply in replies if reply.ok is not None]
        except (NetworkError, zenoh.ZError):
            continue
        found += [FoundArena(token.partition("/")[0], endpoints) for token in sorted(tokens)]
    return found


def choose_arena(found: Sequence[FoundArena], arena: str | None) -> FoundArena | None:
    """The arena of that name, or the only one; None if there is none.

    Raises:
        ConfigError: there are several, and no name chooses one.
    """
    matching = [each for each in found if arena in (None, each.arena)]
    if len(matching) > 1:
        names = ", ".join(f"{each.arena} at {each.endpoints[0]}" for each in matching)
        raise ConfigError(f"several arenas are in this network: {names}; choose with --arena or --connect")
    return matching[0] if matching else None


def _scout() -> list[tuple[str, ...]]:
    """The endpoints of each router that answers."""
    config = zenoh.Config()
    config.insert_json5("scouting/multicast/enabled", "true")
    routers: dict[str, tuple[str, ...]] = {}

    def receive(hello: zenoh.Hello) -> None:
        if len(routers) < MAX_ROUTERS:
            routers[str(hello.zid)] = tuple(hello.locators)

    scout = zenoh.scout(receive, what="router", config=config)
    threading.Event().wait(SCOUT_S)
    scout.stop()
    return [endpoints for endpoints in routers.values() if endpoints]


@dataclass(frozen=True, kw_only=True)
class Connection:
    """The arena's server: the options by which every command reaches it."""

    connect: tuple[str, ...] = ("tcp/127.0.0.1:7447",)
    """Zenoh endpoints of the server."""
    arena: str = "arena"
    """The arena's name, as in the server's configuration."""
    zenoh: Path | None = None
    """A Zenoh configuration (JSON5) for TLS, access control or scouting."""

    def open(self) -> Session:
        """Open a session with a server that runs; raises as `open_client`, and ConfigError for a bad name."""
        require_name(self.arena, "an arena")
        return open_client(self.connect, self.zenoh)

    def wait(self) -> ServerConnection:
        """A session that opens as soon as the server answers; raises as `ServerConnection`."""
        return ServerConnection(self.connect, self.zenoh)

    def options(self) -> list[str]:
        """The options that differ from their defaults, as words of a command line."""
        words = []
        if self.connect != LOCAL_SERVER.connect:
            words += ["--connect", *self.connect]
        if self.arena != LOCAL_SERVER.arena:
            words += ["--arena", self.arena]
        return words + (["--zenoh", str(self.zenoh)] if self.zenoh is not None else [])


ConnectionOptions = Annotated[Connection, tyro.conf.arg(name="")]  # as --connect, not --connection.connect
LOCAL_SERVER = Connection()
