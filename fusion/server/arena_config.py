# SPDX-License-Identifier: BSD-3-Clause
"""The live server's settings: `configs/arena.yaml`, all of them with defaults."""

import re
from collections import Counter
from pathlib import Path

import msgspec

from camera_node.foundation.config import NAME_RULE, is_name, load_yaml
from camera_node.foundation.errors import ConfigError, most_similar
from camera_node.protocol.session import LOOPBACK
from fusion.model.limits import LimitSettings

ANY_HOST = re.compile(r"(\w+)/.*:(\d+)")


class Zone(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A part of an arena with a server of its own.

    Attributes:
        name: a part of Zenoh keys, as names of cameras are.
        server: the Zenoh endpoint at which the other servers and programs reach the zone's server.
        cameras: the names of its cameras.
    """

    name: str
    server: str
    cameras: tuple[str, ...]


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
        refine: whether the server corrects poses and lenses of cameras by what robots in motion show of them.
        zones: of an arena with several servers; the first one has the clock, the rig and the robots for all.
        zone: the name of this server's zone.
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
    limits: LimitSettings = LimitSettings()
    refine: bool = True
    zones: tuple[Zone, ...] = ()
    zone: str | None = None

    def __post_init__(self) -> None:
        if not is_name(self.arena):
            raise ValueError(f"'{self.arena}' can't name an arena; {NAME_RULE}")
        if self.rate_hz is not None and not 0.1 <= self.rate_hz <= 1000:
            raise ValueError(f"rate_hz is {self.rate_hz}; it must be within 0.1 and 1000")
        if not self.listen:
            raise ValueError("listen names no endpoint; give one such as tcp/0.0.0.0:7447")
        self._require_zones()

    @property
    def leads(self) -> bool:
        """Whether this is the arena's only server, or that of the first zone."""
        return not self.zones or self.zones[0].name == self.zone

    def _require_zones(self) -> None:
        names = [zone.name for zone in self.zones]
        if invalid := [name for name in names if not is_name(name)]:
            raise ValueError(f"'{invalid[0]}' can't name a zone; {NAME_RULE}")
        listed = Counter((*names, *(camera for zone in self.zones for camera in set(zone.cameras))))
        if repeated := [name for name, count in listed.items() if count > 1]:
            raise ValueError(
                f"zones: '{repeated[0]}' is there twice; each zone has a name and cameras of its own"
            )
        if self.zone is not None and self.zone not in names:
            similar = most_similar(self.zone, names)
            hint = f"did you mean {similar}? " if similar else ""
            known = f"the zones are {', '.join(names)}" if names else "arena.yaml has no zones"
            raise ValueError(f"there is no zone '{self.zone}'; {hint}{known}")

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


def in_zone(config: ArenaConfig, name: str | None) -> ArenaConfig:
    """The config of a zone's server, which listens at the port of the zone's address, on loopback only if that is.

    Args:
        config: of the arena.
        name: of the zone; None without zones, or for the one that `config` names.

    Raises:
        ConfigError: there is no such zone, or the arena has zones and none is named.
    """
    if name is None:
        if config.zones and config.zone is None:
            names = ", ".join(zone.name for zone in config.zones)
            raise ConfigError(f"arena '{config.arena}' has several servers: give --zone, one of {names}")
        return config
    config = override(config, zone=name)
    (server,) = (zone.server for zone in config.zones if zone.name == name)
    return override(
        config, listen=(server if LOOPBACK.fullmatch(server) else ANY_HOST.sub(r"\1/0.0.0.0:\2", server),)
    )


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
