# SPDX-License-Identifier: BSD-3-Clause
"""The live server's settings: `configs/arena.yaml`, all of them with defaults."""

from pathlib import Path

import msgspec

from camera_node.foundation.config import NAME_RULE, is_name, load_yaml
from camera_node.foundation.errors import ConfigError
from fusion.model.limits import Limits


class ArenaConfig(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One arena.

    Attributes:
        arena: its name, the first part of all Zenoh keys.
        listen: Zenoh endpoints on which the server is the router; the operating system chooses port 0.
        zenoh: a Zenoh configuration (JSON5) for TLS, access control or scouting.
        rig: rig.yaml; without one the server waits for a calibration to be published.
        saved_rig: the file that saves a rig that was requested, or corrected after a camera was moved; after a
            restart it is used unless `rig` was changed since. Nothing is saved unless given.
        robots: robots.yaml.
        saved_robots: the same for robots that were defined, renamed or removed while the server ran.
        cameras: the folder for names and settings of cameras that register; nothing is saved unless given.
        audit: the file to which a line is appended for every change of rig and robots over the network.
        rate_hz: poses a second; without it the rate of the fastest camera.
        limits: see `Limits`.
        shard: `2/3` for the second of three processes that share the robots; all but the first connect to `listen`.
    """

    arena: str = "arena"
    listen: tuple[str, ...] = ("tcp/127.0.0.1:7447",)
    zenoh: str | None = None
    rig: str | None = None
    saved_rig: str | None = None
    robots: str = "robots.yaml"
    saved_robots: str | None = None
    cameras: str | None = None
    audit: str | None = None
    rate_hz: float | None = None
    limits: Limits = Limits()
    shard: str = "1/1"

    def __post_init__(self) -> None:
        if not is_name(self.arena):
            raise ValueError(f"'{self.arena}' can't name an arena; {NAME_RULE}")
        if self.rate_hz is not None and not 0.1 <= self.rate_hz <= 1000:
            raise ValueError(f"rate_hz is {self.rate_hz}; it must be within 0.1 and 1000")
        if not self.listen:
            raise ValueError("listen names no endpoint; give one such as tcp/0.0.0.0:7447")

    def saving_folders(self) -> tuple[Path, ...]:
        """The folders in which the server writes, each once."""
        files = (self.saved_rig, self.saved_robots, self.cameras, self.audit)
        return tuple(sorted({Path(file).resolve().parent for file in files if file}))


def load_arena(path: Path) -> ArenaConfig:
    """Read `arena.yaml`; relative paths in it start from its folder.

    Raises:
        ConfigError: the file is missing or broken, or has an unknown field.
    """
    config = load_yaml(path, ArenaConfig)
    paths = {
        name: str(path.parent / value)
        for name in ("rig", "saved_rig", "robots", "saved_robots", "cameras", "audit", "zenoh")
        if (value := getattr(config, name))
    }
    return override(config, **paths)


def override(config: ArenaConfig, **settings: object) -> ArenaConfig:
    """The config with the settings that are not None.

    Raises:
        ConfigError: a setting is invalid.
    """
    given = {k: str(v) if isinstance(v, Path) else v for k, v in settings.items() if v is not None}
    try:
        return msgspec.structs.replace(config, **given)
    except ValueError as error:
        raise ConfigError(str(error)) from None
