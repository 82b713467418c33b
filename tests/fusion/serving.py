# SPDX-License-Identifier: BSD-3-Clause
"""A live server on loopback, a client of it, and the detections of a synthetic arena."""

import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import IO

import msgspec

from calib.rig.rig import Rig, save_rig
from camera_node.foundation.config import dump_yaml
from camera_node.protocol.messages import Detections, Keys, encode
from fusion.client.arena import Arena as Client
from fusion.model.limits import LimitSettings
from fusion.model.robots import save_robots
from fusion.server.arena_config import ArenaConfig, Zone
from fusion.server.server import Server
from tests.conftest import ROOT
from tests.fusion.synthetic import PERIOD_NS, TRIANGLE, Arena, line
from tests.waiting import DEADLINE_S, Inbox, in_thread, wait_for

ARENA = Arena({"a": TRIANGLE}, {"a": line((0.2, 0.1, 0.2), tilt=(0.1, 0.0, 0.3))}, sigma_px=0.05)
KEYS = Keys("test")
REAL_TIME_MS = LimitSettings().lateness_ms  # of a server whose cameras send frames when they take them
ATTEMPT_S = 3.0  # from a burst of frames to poses, before the burst is sent again


def config(folder: Path, with_rig: bool = True, lateness_ms: float = 5000) -> ArenaConfig:
    """The settings of a server on a port that the operating system chooses; writes rig.yaml and robots.yaml.

    Frames are sent in one burst unless a test says otherwise: every frame set waits to be complete.
    """
    save_rig(Rig(cameras=ARENA.cameras), folder / "rig.yaml")
    save_robots({"a": TRIANGLE}, folder / "robots.yaml")
    rig = str(folder / "rig.yaml") if with_rig else None
    return ArenaConfig(
        arena="test",
        listen=("tcp/127.0.0.1:0",),
        rig=rig,
        robots=str(folder / "robots.yaml"),
        limits=LimitSettings(lateness_ms=lateness_ms),
    )


def zones_of(cameras: dict[str, tuple[str, ...]], endpoint: str) -> tuple[Zone, ...]:
    """Zones with the names of their cameras; other zones reach the first one's server at an endpoint."""
    return tuple(Zone(name=name, server=endpoint, cameras=names) for name, names in cameras.items())


@contextmanager
def serving(settings: ArenaConfig) -> Iterator[tuple[Server, Client]]:
    """A server that runs in a thread, and a client that has reached it."""
    with Server(settings) as server, running_server(server), connected(server) as client:
        yield server, client


def running_server(server: Server) -> AbstractContextManager[None]:
    """Serve in a thread until the block ends."""
    return in_thread(server.run, server.stop)


@contextmanager
def connected(server: Server) -> Iterator[Client]:
    """A client that has reached the server."""
    with Client.connect(*server.endpoints, arena="test") as client:
        wait_for(lambda: list(client.session.get(KEYS.clock, timeout=1.0)))
        yield client


def live(messages: list[Detections], ago_ns: int = 10**9) -> list[Detections]:
    """The messages as if their first frame was taken `ago_ns` ago."""
    shift = time.time_ns() - ago_ns - messages[0].t_ns
    return [msgspec.structs.replace(m, t_ns=m.t_ns + shift, sent_ns=m.t_ns + shift) for m in messages]


def later(messages: list[Detections]) -> list[Detections]:
    """The messages as if the same cameras, in their rhythm, had taken them in the last second."""
    shift = round((time.time_ns() - messages[-1].t_ns) / PERIOD_NS) * PERIOD_NS
    return [msgspec.structs.replace(m, t_ns=m.t_ns + shift, sent_ns=m.t_ns + shift) for m in messages]


def send(server: Server, messages: list[Detections]) -> None:
    """Publish messages on the server's own session; its queue keeps their order."""
    for message in messages:
        server.session.put(KEYS.detections(message.camera), encode(message))


def send_until_tracked(server: Server, client: Client, messages: list[Detections]) -> None:
    """Publish messages until a pose of robot a arrives that is tracked.

    On a busy machine all poses of a burst may be published before the subscription reaches the server.
    """
    poses = Inbox()
    client.robot("a").on_pose(poses.put)

    def is_tracked() -> bool:
        send(server, later(messages))
        return poses.until(lambda items: any(pose.state == "tracked" for pose in items), ATTEMPT_S)

    wait_for(is_tracked)


class ServerProcess:
    """A server in a process of its own, killed and started again on the same port; a context manager.

    Args:
        settings: as `config` makes them.
        log: a file, in the place of this program's standard error.

    Attributes:
        endpoint: on which it listens.
    """

    def __init__(self, settings: ArenaConfig, log: IO[str] | None = None) -> None:
        self._settings, self._log = settings, log
        self.start()

    def __enter__(self) -> "ServerProcess":
        return self

    def __exit__(self, *exception: object) -> None:
        self.kill()

    def start(self) -> None:
        """Start the server and wait until it listens."""
        folder = Path(self._settings.robots).parent
        file, endpoints = folder / "arena.yaml", folder / "endpoints"
        endpoints.unlink(missing_ok=True)
        file.write_text(dump_yaml(self._settings))
        words = ["--config", str(file), "--endpoints-file", str(endpoints)]
        command = [sys.executable, "-m", "fusion", *words]
        self.process = subprocess.Popen(command, cwd=ROOT, stderr=self._log)
        wait_for(lambda: endpoints.exists() or self.process.poll() is not None)
        assert self.process.poll() is None, "the server ended"
        (self.endpoint,) = endpoints.read_text().split()
        self._settings = msgspec.structs.replace(self._settings, listen=(self.endpoint,))

    def kill(self) -> None:
        """End the server by SIGKILL."""
        self.process.kill()
        self.process.wait()


@contextmanager
def serving_process(
    settings: ArenaConfig, log: IO[str] | None = None
) -> Iterator[tuple[str, subprocess.Popen[bytes]]]:
    """A server in a process of its own, and the endpoint on which it listens; SIGTERM must end it with exit code 0."""
    with ServerProcess(settings, log) as server:
        yield server.endpoint, server.process
        server.process.terminate()
        assert server.process.wait(DEADLINE_S) == 0
