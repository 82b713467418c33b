# SPDX-License-Identifier: BSD-3-Clause
"""`roundel up`: the server, its page and the cameras of this machine.

Read `ArenaUp.run` first: it lists the steps.
"""

import contextlib
import threading
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from camera_node.foundation.errors import TEMPORARY_FAILURE, USER_ERROR, ConfigError
from camera_node.foundation.folder_lock import locked_folder
from camera_node.foundation.service import ServiceManager, stopped_by_signals
from camera_node.foundation.supervisor import Supervisor
from camera_node.foundation.terminal import say
from camera_node.protocol.server_connection import LOCAL_SERVER
from camera_node.protocol.session import ENDPOINT
from camera_node.sources.frame import SourceSettings
from fusion.server.arena_config import ArenaConfig, in_zone, load_arena
from web.arena_folder import ArenaFolder
from web.arena_programs import ArenaPrograms
from web.view import check_port

TICK_S = 0.25


@dataclass(frozen=True, kw_only=True)
class RunArena:
    """Run an arena on this machine: the server, its page, and one node for each of its cameras.

    All that it learns is stored in the folder: names and settings of cameras, rig, robots, recordings. Cameras of other
    machines join with roundel camera. The network must be trusted, or protected as docs/security.md describes.
    """

    folder: Annotated[Path, tyro.conf.Positional] = Path("arena")
    """The arena's folder; created if it does not exist."""
    source: tuple[str, ...] | None = None
    """Sources of this machine, as in roundel camera; all its cameras unless given. Without a value: none."""
    arena: str | None = None
    """The arena's name, for a new folder; arena unless given."""
    listen: str | None = None
    """The server's Zenoh endpoint; that of arena.yaml unless given, in a new folder tcp/0.0.0.0:7447."""
    zone: str | None = None
    """The name of this server's zone, of an arena with several servers (zones in arena.yaml)."""
    local: bool = False
    """For a new folder: serve programs of this machine only."""
    headless: bool = False
    """Serve no page."""
    host: str = "127.0.0.1"
    """Address of the page; 0.0.0.0 makes it available to the whole network, with tokens in its addresses."""
    port: int = 8080
    """Port of the page."""
    settings: Annotated[SourceSettings, tyro.conf.OmitArgPrefixes] = field(default_factory=SourceSettings)

    def run(self) -> int:
        """Run until stopped; return the exit code."""
        if not self.headless:
            check_port(self.host, self.port)
        if self.listen is not None and not ENDPOINT.fullmatch(self.listen):
            raise ConfigError(f"--listen {self.listen} is no endpoint; give one such as tcp/0.0.0.0:7447")
        folder = ArenaFolder(self.folder)
        is_new = folder.create(self.arena or LOCAL_SERVER.arena, self.listen, self.local)
        config = in_zone(load_arena(folder.config), self.zone)
        if self.arena not in (None, config.arena):
            raise ConfigError(
                f"the arena in {self.folder} is called {config.arena}; change its name in {folder.config}, or name "
                "another folder"
            )
        say(f"{'created' if is_new else 'using'} the arena in {self.folder.resolve()}")
        with locked_folder(self.folder, "roundel up"), stopped_by_signals() as stop:
            return ArenaUp(folder, config, stop).run(self)


class ArenaUp:
    """Runs the programs of an arena until `stop` is set."""

    def __init__(self, folder: ArenaFolder, config: ArenaConfig, stop: threading.Event) -> None:
        self._folder, self._config, self._stop = folder, config, stop
        self._failed: dict[str, int] = {}

    def run(self, options: RunArena) -> int:
        """Start the server, then the page and the cameras, and watch them; return the exit code."""
        with contextlib.ExitStack() as stack:
            supervisor = stack.enter_context(Supervisor(self._note_end))
            service = stack.enter_context(ServiceManager())
            programs = ArenaPrograms(supervisor, self._folder, self._config)
            endpoints = programs.start_server(options.listen, self._stop)
            if not endpoints:
                return self._failed.get("server", 0)
            self._report(endpoints)
            if not options.headless:
                programs.start_page(options.host, options.port)
            cameras = programs.cameras(options.source or (), options.settings)
            if options.source is None or options.source:
                cameras.start()
            service.ready()
            return self._watch(supervisor, service, cameras.look if options.source is None else None)

    def _report(self, endpoints: list[str]) -> None:
        say(f"server of arena '{self._config.arena}' at {' '.join(endpoints)}")
        if any("127.0.0.1" not in endpoint for endpoint in endpoints):
            say("cameras of other machines in this network join with: roundel camera")

    def _watch(
        self, supervisor: Supervisor, service: ServiceManager, look: Callable[[], object] | None
    ) -> int:
        """Keep the programs running until this one is stopped, or until the server needs a user."""
        while not self._stop.wait(TICK_S):
            supervisor.tend()
            service.progress()
            if look is not None:
                look()
            if "server" not in supervisor:
                return self._failed.get("server", TEMPORARY_FAILURE)
        return 0

    def _note_end(self, name: str, code: int) -> None:
        self._failed[name] = code
        needs_user = "needs a correction, see its error above" if code == USER_ERROR else "ended"
        say(f"{name}: {needs_user}")
