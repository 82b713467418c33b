# SPDX-License-Identifier: BSD-3-Clause
"""`roundel camera`: all cameras of this machine, or those given, in the arena of this network."""

import threading
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Annotated

import msgspec
import tyro
from rich.table import Table

from camera_node.commands.camera_check import check_cameras
from camera_node.commands.relative_settings import RelativeSettings
from camera_node.foundation.config import require_name
from camera_node.foundation.errors import CameraAbsentError, ConfigError
from camera_node.foundation.service import ServiceManager, stopped_by_signals
from camera_node.foundation.supervisor import Supervisor
from camera_node.foundation.terminal import console, progress_console, say
from camera_node.protocol.server_connection import FoundArena, choose_arena, find_arenas
from camera_node.sources.camera_description import CameraDescription, Mode
from camera_node.sources.drivers import all_cameras, identify, local_cameras
from camera_node.sources.frame import SourceSettings, without_credentials
from camera_node.sources.recorded_frames import FrameFolder

TICK_S = 0.25
MAX_CHECK_S = 3600.0
SHOWN_SIZES = 4  # of one camera in the table of --list
LOOK_S = 3.0  # between looks for cameras that were plugged in


@dataclass(frozen=True)
class JoinArena:
    """Publish the cameras of this machine in an arena, until stopped.

    The server is found by scouting, or given by --connect. It names each camera once, and stores its name and settings.
    """

    source: tuple[str, ...] = ()
    """Cameras by number (0), path (/dev/video2) or name; genicam:SERIAL; picamera:NUMBER; addresses of streams; videos;
    folders of <t_ns>.png|jpg; or sim:NAME. All cameras of this machine unless given, also those that are plugged in
    later; cameras of the network are given by name."""
    name: str | None = None
    """A fixed name for a single source; the server neither names it nor stores its settings."""
    connect: tuple[str, ...] = ()
    """Zenoh endpoints of the server, such as tcp/server:7447; found by scouting unless given."""
    arena: str | None = None
    """The arena's name; the only one of the server unless given."""
    zenoh: Path | None = None
    """A Zenoh configuration file (JSON5) for TLS, access control or scouting; requires --connect."""
    listen: tuple[str, ...] = ()
    """Run one camera without a server, as on a robot: be the Zenoh router that listens on these endpoints, such as
    tcp/127.0.0.1:7447, to which the robot's programs connect. Requires --name."""
    show_list: Annotated[bool, tyro.conf.arg(name="list")] = False
    """Print the cameras of all drivers with their modes, and end."""
    check: bool = False
    """Read each camera for --seconds and report stamps, rate, losses, light and focus; publish nothing."""
    seconds: float = 10.0
    """Duration of --check for each camera."""
    as_json: Annotated[bool, tyro.conf.arg(name="json")] = False
    """Print --list or --check as JSON; the list then has all controls with their limits."""
    relative: Annotated[RelativeSettings, tyro.conf.OmitArgPrefixes] = field(default_factory=RelativeSettings)
    settings: Annotated[SourceSettings, tyro.conf.OmitArgPrefixes] = field(default_factory=SourceSettings)

    def run(self) -> int:
        """Run one node per camera until stopped, or until all recordings ended."""
        if self.show_list:
            return list_cameras(self.as_json)
        self._check()
        with stopped_by_signals() as stop:
            if self.check:
                sources = self.source or tuple(local_cameras())
                return check_cameras(sources, self.settings, self.seconds, self.as_json, stop)
            found = self._find(stop)
            if found is None:
                return 0
            cameras = LocalCameras(self.source, self._options(found))
            return cameras.run(stop)

    def _check(self) -> None:
        self._check_report()
        if self.arena is not None:
            require_name(self.arena, "an arena")
        if self.name is not None:
            require_name(self.name, "a camera")
            if len(self.source) != 1:
                raise ConfigError("--name names one camera: give one --source with it")
        self._check_listen()
        self.relative.check()
        if self.zenoh is not None and not (self.connect or self.listen):
            raise ConfigError("--zenoh needs --connect: a protected server is not found by scouting")
        self.settings.check()
        for source in self.source:
            identify(source)  # before a server is looked for
            if Path(source).is_dir():
                FrameFolder(Path(source))
        if not self.source and not local_cameras():
            raise CameraAbsentError(
                "this machine has no camera; plug one in, or give --source (roundel camera --list shows them)"
            )

    def _check_report(self) -> None:
        if self.as_json and not self.check:
            raise ConfigError("--json prints --list or --check; give one of them with it")
        if not 0 < self.seconds <= MAX_CHECK_S:
            raise ConfigError(f"--seconds {self.seconds:g}: give a duration of up to {MAX_CHECK_S:g} s")

    def _check_listen(self) -> None:
        if self.listen and self.connect:
            raise ConfigError("--listen runs without a server; give it or --connect, not both")
        if self.listen and self.name is None:
            raise ConfigError("--listen runs without a server, which would name the camera; give --name")

    def _find(self, stop: threading.Event) -> FoundArena | None:
        """The arena to join; None if this program is stopped first."""
        if self.connect or self.listen:
            return FoundArena(self.arena or "arena", self.connect)
        waited = False
        while not stop.is_set():
            if found := choose_arena(find_arenas(), self.arena):
                say(f"found arena '{found.arena}' at {found.endpoints[0]}")
                return found
            if not waited:
                say(
                    "no server found in this network yet; looking. Start one with roundel up, or give --connect"
                )
                waited = True
        return None

    def _options(self, found: FoundArena) -> list[str]:
        options = ["--listen", *self.listen] if self.listen else ["--connect", *found.endpoints]
        options += ["--arena", found.arena, *given_options(self.settings)]
        options += given_options(self.relative)
        if self.name is not None:
            options += ["--name", self.name]
        return options + (["--zenoh", str(self.zenoh)] if self.zenoh else [])


def given_options(settings: SourceSettings | RelativeSettings) -> list[str]:
    """The options that differ from their defaults."""
    values, defaults = asdict(settings), asdict(type(settings)())
    return [
        word
        for name, value in values.items()
        if value != defaults[name]
        for word in (f"--{name.replace('_', '-')}", *map(str, value if isinstance(value, tuple) else [value]))
    ]


class LocalCameras:
    """One node for each source, or for each camera of this machine, in processes of their own.

    Args:
        sources: as `--source`; empty for all cameras of this machine.
        options: of `python -m camera_node`, without `--source`.
        supervisor: runs the nodes; one of its own unless given.
    """

    def __init__(
        self, sources: Sequence[str], options: Sequence[str], supervisor: Supervisor | None = None
    ) -> None:
        self._sources, self._options = tuple(sources), tuple(options)
        self._supervisor = supervisor or Supervisor(self._ended)
        self._code = 0
        self._next_look_s = 0.0
        self._seen: set[str] = set()

    def start(self) -> None:
        """Start a node for each source that has none yet."""
        self._next_look_s = time.monotonic() + LOOK_S
        present = self._sources or tuple(local_cameras())
        self._seen &= set(present)  # a camera that was unplugged may come back
        for source in present:
            if source not in self._seen:
                self._seen.add(source)
                options = ["--source", source, *self._options]
                self._supervisor.start(f"camera {without_credentials(source)}", "camera_node", options)

    def run(self, stop: threading.Event) -> int:
        """Run the nodes until `stop`, or until all sources ended; return 0, or the code of one that failed."""
        with self._supervisor as supervisor, ServiceManager() as service:
            self.start()
            service.ready()
            while not stop.wait(TICK_S) and (len(supervisor) or not self._sources):
                supervisor.tend()
                service.progress()
                self.look()
        return self._code

    def look(self) -> None:
        """Start nodes for cameras that were plugged in; called a few times a second."""
        if not self._sources and time.monotonic() >= self._next_look_s:
            self.start()

    def _ended(self, name: str, code: int) -> None:
        if code:
            self._code = code
        else:
            say(f"{name}: ended")


def list_cameras(as_json: bool) -> int:
    """Print all cameras with their modes, as a table or as JSON with all controls; 1 if there is none."""
    cameras, absent = all_cameras()
    if as_json:
        say(msgspec.json.format(msgspec.json.encode(cameras)).decode())
        return 0 if cameras else 1
    if cameras:
        console().print(_table(cameras))
    for fault in absent:
        say(f"not searched: {fault}", progress_console() if cameras else None)
    if not cameras:
        say(
            "no camera found; check power and cables. Network streams are not searched: give --source rtsp://..."
        )
    return 0 if cameras else 1


def _table(cameras: list[CameraDescription]) -> Table:
    table = Table("--source", "camera", "serial", "modes", "controls", "note")
    for camera in cameras:
        controls = str(len(camera.controls)) if camera.controls else ""
        table.add_row(
            camera.source, camera.name, camera.serial, _summary(camera.modes), controls, camera.note
        )
    return table


def _summary(modes: tuple[Mode, ...]) -> str:
    """The largest sizes, each with its pixel formats and its greatest rate."""
    sizes = sorted({(mode.width, mode.height) for mode in modes}, reverse=True)
    lines = []
    for width, height in sizes[:SHOWN_SIZES]:
        same = [mode for mode in modes if (mode.width, mode.height) == (width, height)]
        rate = max((mode.max_fps or 0.0 for mode in same), default=0.0)
        pixels = ", ".join(dict.fromkeys(mode.pixels.strip() for mode in same))
        lines.append(f"{width} x {height}{f' {rate:.0f} Hz' if rate else ''} ({pixels})")
    more = [f"and {len(sizes) - SHOWN_SIZES} smaller sizes"] if len(sizes) > SHOWN_SIZES else []
    return "\n".join(lines + more)
