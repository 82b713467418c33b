# SPDX-License-Identifier: BSD-3-Clause
"""Starts the programs of an arena as children of this process: the server, its page and cameras."""

import tempfile
import threading
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from camera_node.commands.camera_command import LocalCameras, given_options
from camera_node.foundation.errors import NetworkError
from camera_node.foundation.supervisor import Supervisor
from camera_node.sources.frame import SourceSettings
from fusion.server.arena_config import ArenaConfig
from web.arena_folder import ArenaFolder
from web.page_access import PageAccess, is_loopback

START_S = 120.0  # for the server to listen, on a loaded machine
POLL_S = 0.05
ENCRYPTED = ("tls/", "quic/")
CALIBRATION = "calib"  # the name of its process


class ArenaPrograms:
    """The server, the page and the cameras of an arena.

    They run in the arena's folder, to which the paths of certificates in its Zenoh configuration are relative. Under
    TLS all of them have the server's certificate: whoever starts them can read it.

    Args:
        supervisor: runs them; its user tends it.
        folder: the arena's files.
        config: the content of its arena.yaml.
    """

    def __init__(self, supervisor: Supervisor, folder: ArenaFolder, config: ArenaConfig) -> None:
        self._supervisor, self._folder, self._config = supervisor, folder.resolved(), config
        supervisor.folder = self._folder.path
        self._connect: list[str] = []

    def start_server(self, listen: str | None, stop: threading.Event) -> list[str]:
        """Start the server, and wait until it listens.

        Args:
            listen: a Zenoh endpoint in place of those of the folder; its port may be 0, for any free port.
            stop: ends the wait.

        Returns:
            The endpoints on which it listens; empty if it ended, or at `stop`.

        Raises:
            NetworkError: it did not listen in time.
        """
        with tempfile.TemporaryDirectory(prefix="roundel-up-") as temporary:
            path, end_s = Path(temporary) / "endpoints", time.monotonic() + START_S
            words = ["--config", str(self._folder.config), "--endpoints-file", str(path)]
            words += ["--zone", self._config.zone] if self._config.zone else []
            words += ["--listen", listen] if listen else []
            self._supervisor.start("server", "fusion", words)
            while not path.exists():
                self._supervisor.tend()
                if "server" not in self._supervisor or stop.wait(POLL_S):
                    return []
                if time.monotonic() > end_s:
                    raise NetworkError(f"the server did not listen within {START_S:.0f} s; see its log")
            endpoints = path.read_text().splitlines()
        local = endpoints[0].replace("0.0.0.0", "127.0.0.1")
        self._connect = ["--connect", local, "--arena", self._config.arena]
        if self._config.zenoh is not None and local.startswith(ENCRYPTED):
            self._connect += ["--zenoh", str(Path(self._config.zenoh).resolve())]
        return endpoints

    def start_page(self, host: str, port: int) -> PageAccess:
        """Start the page, with tokens in the folder if other machines may open it; return the ways to open it."""
        tokens = None if is_loopback(host) else self._folder.path / "page_tokens.yaml"
        access = PageAccess.create(host, port, tokens)  # writes the tokens before the page reads them
        words = ["--host", host, "--port", str(port), *(["--tokens", str(tokens)] if tokens else [])]
        words += ["--rig", str(self._folder.rig), "--wand", str(self._folder.wand)]
        words += ["--folder", str(self._folder.recordings)]
        self._supervisor.start("page", "web", [*self._connect, *words])
        return access

    def cameras(self, sources: Sequence[str], settings: SourceSettings) -> LocalCameras:
        """The cameras of this machine, not started yet; all of them without sources."""
        if settings.scene is not None:
            settings = replace(settings, scene=settings.scene.resolve())
        paths = [str(Path(source).resolve()) if Path(source).exists() else source for source in sources]
        return LocalCameras(paths, [*self._connect, *given_options(settings)], self._supervisor)

    def start_wand_calibration(self, seconds: float) -> None:
        """Start `roundel calibrate wand` on the running cameras; it writes the rig and has the server use it."""
        rig = str(self._folder.rig)
        words = ["wand", "--live", "--seconds", str(seconds), "--wand", str(self._folder.wand)]
        self._supervisor.start(CALIBRATION, "calib", [*words, "--rig", rig, "--out", rig, *self._connect])
