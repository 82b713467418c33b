# SPDX-License-Identifier: BSD-3-Clause
"""The folder of an arena: all that `roundel up` learns, in the formats of the single programs.

arena.yaml     the server's configuration
rig.yaml       lenses and poses of the cameras; rig.N.yaml are older ones, rig.undone.N.yaml undone ones
robots.yaml    the robots
wand.yaml      the wand
cameras/       name, id and settings of each camera
recordings/    recordings
zenoh.json5    how the server is found in the network
"""

from dataclasses import dataclass
from pathlib import Path

from camera_node.foundation.config import example_file, require_name, write_atomically
from camera_node.foundation.errors import ConfigError

ARENA = """\
# Written by `roundel up`; edit it freely. configs/arena.yaml of the package describes all settings.
arena: {arena}
listen: ["{listen}"]
zenoh: zenoh.json5
saved_rig: rig.yaml
robots: robots.yaml
saved_robots: robots.yaml
cameras: cameras
audit: audit.jsonl
"""
ZENOH = """\
// Written by `roundel up`; edit it freely. By multicast scouting, `roundel camera` on other machines finds the server.
// docs/security.md describes how to protect the arena.
{{ scouting: {{ multicast: {{ enabled: {scouting} }} }} }}
"""
PORT = 7447


@dataclass(frozen=True)
class ArenaFolder:
    """The paths of an arena's files."""

    path: Path

    @property
    def config(self) -> Path:
        return self.path / "arena.yaml"

    @property
    def rig(self) -> Path:
        return self.path / "rig.yaml"

    @property
    def wand(self) -> Path:
        return self.path / "wand.yaml"

    @property
    def recordings(self) -> Path:
        return self.path / "recordings"

    def resolved(self) -> "ArenaFolder":
        """The same folder by its absolute path."""
        return ArenaFolder(self.path.resolve())

    def create(self, arena: str, listen: str | None, is_local: bool) -> bool:
        """Write the files that are missing; return whether the folder is new.

        Args:
            arena: the arena's name.
            listen: the server's Zenoh endpoint; port 7447 unless given.
            is_local: serve this machine only, unless `listen` is given.

        Raises:
            ConfigError: the folder can't be created or written, or the name is invalid.
        """
        require_name(arena, "an arena")
        try:
            for folder in (self.path, self.path / "cameras", self.recordings):
                folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise ConfigError(
                f"{self.path} can't be used as a folder: {error.strerror}; name another one"
            ) from None
        is_new = not self.config.exists()
        host = "127.0.0.1" if is_local else "0.0.0.0"
        _write_missing(self.config, ARENA.format(arena=arena, listen=listen or f"tcp/{host}:{PORT}"))
        scouting = "false" if is_local else "true"
        _write_missing(self.path / "zenoh.json5", ZENOH.format(scouting=scouting))
        _write_missing(self.wand, example_file("wand.yaml").read_text(encoding="utf-8"))
        return is_new


def _write_missing(path: Path, text: str) -> None:
    if not path.exists():
        write_atomically(path, text)
