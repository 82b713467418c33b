# SPDX-License-Identifier: BSD-3-Clause
"""The command line: `python -m fusion` is the live server; `run`, `record` and `replay` are about recordings;
`define` and `undo` ask something of a server that runs, `ros2` passes its poses on."""

import logging
import signal
import sys
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path

import tyro

from camera_node.errors import check_command, run

# imported when asked for: what runs on a robot's computer has neither GTSAM nor SciPy
COMMANDS = {
    "run": "fusion.recordings.run",
    "replay": "fusion.recordings.run",
    "record": "fusion.recordings.record",
    "define": "fusion.client.define",
    "undo": "fusion.client.undo",
    "ros2": "fusion.bridges.ros2",
}


@dataclass(frozen=True)
class Serve:
    """Fuse what an arena's cameras publish into robot poses, until stopped; holds the arena's Zenoh router.

    For recordings: python -m fusion run | record | replay --help
    For a new robot, measured where it stands: python -m fusion define --help
    For a camera that was placed anew wrongly: python -m fusion undo --help
    For the robots as topics of ROS 2: python -m fusion ros2 --help
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
    """Instants a second; those of the fastest camera unless given."""
    shard: str | None = None
    """Such as 2/3, the second of three processes that share the robots; the first is the one to listen."""

    def run(self) -> int:
        """Serve until Ctrl-C or SIGTERM."""
        from dataclasses import asdict

        from camera_node.config import write_atomically
        from fusion.server.config import ArenaConfig, load_arena, override
        from fusion.server.server import Server

        settings = asdict(self)
        path, endpoints_file = settings.pop("config"), settings.pop("endpoints_file")
        config = override(load_arena(path) if path else ArenaConfig(), **settings)
        signal.signal(signal.SIGTERM, signal.default_int_handler)
        try:
            with Server(config) as server:
                if endpoints_file:
                    write_atomically(endpoints_file, "".join(f"{e}\n" for e in server.endpoints))
                server.run()
        except KeyboardInterrupt:
            pass
        return 0


def main() -> None:
    """The entry point of `roundel-fusion`."""
    logging.basicConfig(level=logging.INFO, format="%(levelname)s %(name)s %(message)s")
    run(_program)


def _program() -> int:
    check_command(sys.argv[1:], tuple(COMMANDS))
    name, *arguments = sys.argv[1:] or [""]
    if name not in COMMANDS:
        return tyro.cli(Serve, prog="fusion").run()
    command = getattr(import_module(COMMANDS[name]), name)
    return tyro.cli(command, prog=f"fusion {name}", args=arguments)


if __name__ == "__main__":
    main()
