# SPDX-License-Identifier: BSD-3-Clause
"""Interrupted and slow links, and a killed server: `python -m tests.benchmarks.network` (as root, for namespaces).

The server, each of eight cameras, and page, viewer, client, recorder and ROS 2 bridge run in network namespaces of
their own, with real addresses.
"""

import math
import socket
import tempfile
import time
from collections.abc import Sequence
from contextlib import closing, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, get_args

import tyro
import zenoh

from camera_node.foundation.terminal import say
from camera_node.protocol.messages import Detections, decode
from tests.benchmarks.faults.arena import LiveArena, small_load
from tests.benchmarks.faults.network import Namespaces, why_not
from tests.benchmarks.faults.world import CameraFault

Part = Literal["link", "cameras", "all", "server", "slow"]
CLIENTS = ("viewer", "page", "recorder", "listener", "bridge")
PROGRAMS = {"client": "listener", "bridge": "bridge", "recorder": "recorder"}  # that receive poses
ODOMETRY = "0/*/odometry/**"  # of all robots in ROS 2's domain 0
DEADLINE_S = 30.0
FRESH_NS = 150_000_000  # age of a frame, up to which the server uses it
FALSE = 160  # roundels that make the frames of a camera too large for its link


@dataclass(frozen=True)
class Outage:
    """What an interruption cost: the time until a frame of the camera was fresh again, and the longest gap, seconds."""

    away_s: float
    back_s: float
    gap_s: float


@dataclass(frozen=True)
class Blackout:
    """What an interruption of all links cost: the seconds from their return to the poses of all robots at the server,
    at a client, at the ROS 2 bridge and in the recording; 0 for a program that does not run."""

    away_s: float
    server_s: float
    client_s: float
    bridge_s: float
    recorder_s: float

    @property
    def worst_s(self) -> float:
        return max(self.server_s, self.client_s, self.bridge_s, self.recorder_s)


@dataclass(frozen=True)
class Restart:
    """The seconds from kill to readiness of a server, and from there to the poses of the first and of all robots."""

    away_s: float
    ready_s: float
    first_s: float
    all_s: float


class FrameAges:
    """The age of each arriving frame of a camera, ns, and when it arrived by the monotonic clock."""

    def __init__(self, arena: LiveArena, camera: str) -> None:
        self.ages: list[tuple[float, int]] = []
        self._subscriber = arena.session.declare_subscriber(arena.keys.detections(camera), self._take)

    def close(self) -> None:
        self._subscriber.undeclare()

    def fresh_since(self, since_s: float) -> bool:
        """Whether a fresh frame has arrived since a moment."""
        return any(at_s > since_s and age_ns < FRESH_NS for at_s, age_ns in self.ages)

    def _take(self, sample: zenoh.Sample) -> None:
        t_ns = decode(sample.payload.to_bytes(), Detections).t_ns
        self.ages.append((time.monotonic(), time.time_ns() - t_ns))


def interrupt(arena: LiveArena, network: Namespaces, camera: str, seconds: float) -> Outage:
    """Take the link of a camera down for a time.

    Raises:
        TimeoutError: no fresh frame arrives when the link is up again.
    """
    with closing(FrameAges(arena, camera)) as frames:
        arena.judge.gaps.clear()
        network.set_link(camera, False)
        arena.wait(seconds)
        network.set_link(camera, True)
        up_s = time.monotonic()
        wait_until(arena, lambda: frames.fresh_since(up_s), f"fresh frame of {camera}")
        back_s = time.monotonic() - up_s
    return Outage(seconds, back_s, max((gap.seconds for gap in arena.judge.gaps), default=0.0))


class Bridged:
    """When the first odometry arrived that the ROS 2 bridge published after a moment, by the monotonic clock."""

    def __init__(self, arena: LiveArena) -> None:
        self.last_s = 0.0
        self._subscriber = arena.session.declare_subscriber(ODOMETRY, self._take)

    def close(self) -> None:
        self._subscriber.undeclare()

    def _take(self, sample: zenoh.Sample) -> None:
        self.last_s = time.monotonic()


def interrupt_all(arena: LiveArena, network: Namespaces, names: Sequence[str], seconds: float) -> Blackout:
    """Take the links of these programs down at once for a time.

    A program that does not come back within `DEADLINE_S` has infinite seconds.
    """
    with closing(Bridged(arena)) as bridged:
        for name in names:
            network.set_link(name, False)
        arena.wait(seconds)
        recorded = recording_bytes(arena)
        arena.judge.forget()
        for name in names:
            network.set_link(name, True)
        up_s = time.monotonic()
        back: dict[str, float] = {}
        signs = {
            "server": lambda: arena.judge.tracked(1.0) == len(arena.world.names),
            "client": lambda: client_is_back(arena, up_s),
            "bridge": lambda: bridged.last_s > up_s,
            "recorder": lambda: recording_bytes(arena) > recorded,
        }
        back |= {name: 0.0 for name, program in PROGRAMS.items() if program not in arena.extra}

        def all_back() -> bool:
            for name in [name for name, sign in signs.items() if name not in back and sign()]:
                back[name] = time.monotonic() - up_s
            return len(back) == len(signs)

        with suppress(TimeoutError):
            wait_until(arena, all_back, "return of all programs")
    return Blackout(seconds, *(back.get(name, math.inf) for name in signs))


def client_is_back(arena: LiveArena, since_s: float) -> bool:
    """Whether the client has had poses again after a moment."""
    text = (arena.folder / "listener.out").read_text()
    complete = text[: text.rfind("\n") + 1].split()
    return bool(complete) and float(complete[-1]) > since_s


def recording_bytes(arena: LiveArena) -> int:
    return sum(path.stat().st_size for path in arena.folder.glob("recording-*.mcap"))


def squeeze(
    arena: LiveArena, network: Namespaces, camera: str, bits_per_s: int, seconds: float
) -> list[float]:
    """The ages in seconds of the frames that arrive through a link that is too slow, after the first second."""
    arena.place(camera, CameraFault(false=FALSE))
    network.limit(camera, bits_per_s)
    with closing(FrameAges(arena, camera)) as frames:
        begun_s = time.monotonic()
        arena.wait(seconds)
        return [age_ns * 1e-9 for at_s, age_ns in frames.ages if at_s > begun_s + 1.0]


def restart_server(arena: LiveArena, away_s: float) -> Restart:
    """Kill the server, start another one `away_s` later, and wait for the poses of all robots.

    Raises:
        TimeoutError: they do not come back.
    """
    arena.programs.kill("server")
    arena.wait(away_s)
    begun_s = time.monotonic()
    arena.judge.forget()
    arena.start("server")
    wait_until(arena, lambda: listens(arena.endpoint), "listening server")
    ready_s = time.monotonic()
    wait_until(arena, lambda: arena.judge.tracked(1.0), "pose")
    first_s = time.monotonic()
    wait_until(arena, lambda: arena.judge.tracked(1.0) == len(arena.world.names), "poses of all robots")
    return Restart(away_s, ready_s - begun_s, first_s - ready_s, time.monotonic() - ready_s)


def listens(endpoint: str) -> bool:
    """Whether a server listens on an endpoint such as tcp/127.0.0.1:7447."""
    host, port = endpoint.removeprefix("tcp/").split(":")
    with suppress(OSError):
        socket.create_connection((host, int(port)), 0.2).close()
        return True
    return False


def wait_until(arena: LiveArena, condition, content: str) -> None:
    """Wait for a condition.

    Raises:
        TimeoutError: it does not become true within `DEADLINE_S`.
    """
    end_s = time.monotonic() + DEADLINE_S
    while not condition():
        if time.monotonic() > end_s:
            raise TimeoutError(f"no {content} within {DEADLINE_S:g} s")
        arena.wait(0.005)


def main(
    cameras: int = 8,
    away_s: tuple[float, ...] = (0.5, 1.0, 1.4, 2.0, 3.0, 4.0, 6.0, 10.0, 20.0),
    parts: tuple[Part, ...] = get_args(Part),
) -> int:
    """Print what each fault costs; exit code 1 if poses take more than 2 s after a link, or 1 s after the server.

    A short run takes 2 minutes: `--cameras 4 --parts cameras --away-s 0.5 1 1.4 2 3`.

    Args:
        cameras: each in a network namespace of its own.
        away_s: durations of the interruptions, and of the server's absences.
        parts: link: that of one camera; cameras: those of all cameras; all: those of the other programs as well;
            server: killed and started; slow: a link of 1 Mbit/s.
    """
    if reason := why_not():
        say(f"skipped: {reason}")
        return 0
    load = small_load(cameras=cameras)
    with (
        tempfile.TemporaryDirectory(prefix="roundel-network-") as folder,
        Namespaces((*load.rig, *CLIENTS)) as network,
        LiveArena(Path(folder), load, CLIENTS, network) as arena,
    ):
        arena.wait_until_tracked()
        arena.wait(5.0)  # until the programs have started
        failed = [part for part in parts if not holds(part, arena, network, away_s)]
        arena.programs.check()
        for crash in arena.programs.crashes:
            say(f"FAILED {crash}")
    return int(bool(failed or arena.programs.crashes))


def holds(part: Part, arena: LiveArena, network: Namespaces, away_s: Sequence[float]) -> bool:
    """Cause the faults of one part, and print what they cost; whether its limit holds."""
    links = {"cameras": tuple(arena.cameras), "all": (*arena.cameras, *CLIENTS)}
    if part == "link":
        return max(report(interrupt(arena, network, "cam1", seconds)) for seconds in away_s) <= 2.0
    if part in links:
        say(f"links of {', '.join(links[part])}:")
        return max(report(interrupt_all(arena, network, links[part], seconds)) for seconds in away_s) <= 2.0
    if part == "server":
        return max(report(restart_server(arena, seconds)) for seconds in (0.0, *away_s)) <= 1.0
    ages = sorted(squeeze(arena, network, "cam1", 1_000_000, 10.0))
    say(f"1 Mbit/s: {len(ages) / 9:.1f} frames/s, age {ages[len(ages) // 2]:.2f} s, at most {ages[-1]:.2f} s")
    return ages[-1] <= 1.0


def report(result: Outage | Blackout | Restart) -> float:
    """Print a result; return the seconds until all was well."""
    say(str(result))
    if isinstance(result, Blackout):
        return result.worst_s
    return result.back_s if isinstance(result, Outage) else result.all_s


if __name__ == "__main__":
    raise SystemExit(tyro.cli(main))
