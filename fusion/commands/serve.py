# SPDX-License-Identifier: BSD-3-Clause
"""`roundel server`: the live server."""

from dataclasses import asdict, dataclass
from pathlib import Path

from camera_node.foundation.config import write_atomically
from camera_node.foundation.service import stopped_by_signals


@dataclass(frozen=True)
class Serve:
    """Fuse what an arena's cameras publish into robot poses, until stopped; this is the arena's Zenoh router.

    roundel --help lists the other commands, such as health and doctor, which report on a running arena.
    """

    config: Path | None = None
    """arena.yaml; the options below override it."""
    arena: str | None = None
    """The arena's name, the first part of all Zenoh keys."""
    listen: tuple[str, ...] | None = None
    """Zenoh endpoints to listen on, such as tcp/0.0.0.0:7447; the operating system chooses port 0."""
    endpoints_file: Path | None = None
    """A file to write once the server listens: the endpoints at which it is reached, one a line."""
    zenoh: Path | None = None
    """A Zenoh configuration (JSON5) for TLS, access control or scouting."""
    rig: Path | None = None
    """rig.yaml; without one the server waits for a calibration to be published."""
    robots: Path | None = None
    """robots.yaml."""
    rate_hz: float | None = None
    """Poses a second; without it the rate of the fastest camera."""
    zone: str | None = None
    """The name of this server's zone, of an arena with several servers (zones in arena.yaml)."""

    def run(self) -> int:
        """Serve until Ctrl-C or SIGTERM."""
        from fusion.server.arena_config import (  # not at the top: --help needs no GTSAM
            ArenaConfig,
            in_zone,
            load_arena,
            override,
        )
        from fusion.server.server import Server

        settings = asdict(self)
        path, endpoints_file = settings.pop("config"), settings.pop("endpoints_file")
        config = in_zone(load_arena(path) if path else ArenaConfig(), settings.pop("zone"))
        config = override(config, **settings)
        with stopped_by_signals() as stop:
            while not stop.is_set():
                with Server(config, stop) as server:
                    config = override(config, listen=server.endpoints)
                    if endpoints_file:
                        write_atomically(
                            endpoints_file, "".join(f"{endpoint}\n" for endpoint in server.endpoints)
                        )
                    server.run()
        return 0
