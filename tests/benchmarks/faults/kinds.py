# SPDX-License-Identifier: BSD-3-Clause
"""The kinds of faults: what each does to an arena, who must report it, and which gap in the poses it explains."""

import contextlib
import random
from collections.abc import Callable
from dataclasses import dataclass

from msgspec.structs import replace

from camera_node.foundation.errors import RoundelError
from tests.benchmarks.faults.arena import Fuzz, LiveArena
from tests.benchmarks.faults.reports import Evidence, advised, gone, late, suspected
from tests.benchmarks.faults.world import CameraFault, RobotEvent

SHORT_S = 0.1  # a longer gap needs an explanation
LATE_S = 0.35  # a camera falls silent: one frame set waits 0.15 s for it, and association starts again
LONGEST_S = 2.1  # any gap
DISK_BYTES = 300_000

Action = Callable[[], object]


@dataclass
class Fault:
    """A fault of one kind.

    Attributes:
        target: the camera, robot or program.
        begin, end: cause it and end it.
        report: by what it is reported, empty before; None where only who starts the programs can report it.
        seconds: its duration.
        gap_s: the longest gap in the poses of a visible robot that it explains.
        robots: whose poses may have such a gap; None for all.
    """

    target: str
    begin: Action
    end: Action
    report: Callable[[Evidence], str] | None
    seconds: float
    gap_s: float = SHORT_S
    robots: tuple[str, ...] | None = None


def nothing() -> None:
    """The end of a fault that ends by itself."""


# Faults of cameras.


def killed_camera(arena: LiveArena, rng: random.Random) -> Fault:
    name = rng.choice(arena.cameras)
    return Fault(name, lambda: arena.programs.kill(name), lambda: arena.start(name), gone(name), 4.0, LATE_S)


def stopped_camera(arena: LiveArena, rng: random.Random) -> Fault:
    name = rng.choice(arena.cameras)
    pause = arena.programs.pause
    return Fault(name, lambda: pause(name, True), lambda: pause(name, False), gone(name), 4.0, LATE_S)


def silent_camera(arena: LiveArena, rng: random.Random) -> Fault:
    name = rng.choice(arena.cameras)
    return camera_fault(arena, name, CameraFault(silent=True), gone(name), 4.0, LATE_S)


def frozen_camera(arena: LiveArena, rng: random.Random) -> Fault:
    name = rng.choice(arena.cameras)
    return camera_fault(arena, name, CameraFault(picture="frozen"), suspected(name), 4.0, LATE_S)


def black_camera(arena: LiveArena, rng: random.Random) -> Fault:
    name = rng.choice(arena.cameras)
    return camera_fault(arena, name, CameraFault(picture="black"), advised(name, "dark"), 3.0, LATE_S)


def bright_camera(arena: LiveArena, rng: random.Random) -> Fault:
    name = rng.choice(arena.cameras)
    return camera_fault(arena, name, CameraFault(picture="bright"), advised(name, "saturated"), 3.0, LATE_S)


def false_roundels(arena: LiveArena, rng: random.Random) -> Fault:
    """On a busy machine the log has few lines of one kind: then only the status shows it."""
    name, reason = rng.choice(arena.cameras), "frames with too many roundels"

    def report(seen: Evidence) -> str:
        health, n = seen.health(name), seen.count(reason)
        is_counted = n > 0 and health is not None and reason in health.faults
        return seen.logged(name, "roundels") or (f"status: {n} {reason}" if is_counted else "")

    return camera_fault(arena, name, CameraFault(false=4096), report, 3.0, LATE_S)


def lost_frames(arena: LiveArena, rng: random.Random) -> Fault:
    name = rng.choice(arena.cameras)

    def report(seen: Evidence) -> str:
        health = seen.health(name)
        return f"{health.fps:.0f} frames/s" if health and health.fps < 0.8 * arena.load.hz else ""

    return camera_fault(arena, name, CameraFault(loss=0.5), report, 3.0, LATE_S)


def late_frames(arena: LiveArena, rng: random.Random) -> Fault:
    name = rng.choice(arena.cameras)
    return camera_fault(arena, name, CameraFault(delay_ms=rng.uniform(250, 800)), late(name), 3.0, LATE_S)


def swapped_frames(arena: LiveArena, rng: random.Random) -> Fault:
    name = rng.choice(arena.cameras)

    def report(seen: Evidence) -> str:
        health = seen.health(name)
        lateness_ms = health.lateness_ms if health else 0.0
        is_late = lateness_ms > 500 / arena.load.hz
        return seen.logged(name) or (f"lateness {lateness_ms:.0f} ms" if is_late else "")

    return camera_fault(arena, name, CameraFault(swapped=True), report, 3.0, LATE_S)


def doubled_frames(arena: LiveArena, rng: random.Random) -> Fault:
    name = rng.choice(arena.cameras)

    def report(seen: Evidence) -> str:
        n = seen.count("duplicate frame")
        return f"{n} duplicate frames" if n > 5 else ""

    return camera_fault(arena, name, CameraFault(doubled=True), report, 3.0, SHORT_S)


def stepped_clock(arena: LiveArena, rng: random.Random) -> Fault:
    name = rng.choice(arena.cameras)
    step_ms = rng.choice((-1, 1)) * rng.choice((10.0, 25.0, 50.0, 500.0, 1000.0))
    return camera_fault(arena, name, CameraFault(step_ms=step_ms), suspected(name), 5.0, LONGEST_S)


def drifting_clock(arena: LiveArena, rng: random.Random) -> Fault:
    name = rng.choice(arena.cameras)
    fault = CameraFault(drift_ppm=rng.choice((-1, 1)) * rng.choice((2000.0, 5000.0)))
    return camera_fault(arena, name, fault, suspected(name), 5.0, LATE_S)


def moved_camera(arena: LiveArena, rng: random.Random) -> Fault:
    name = rng.choice(arena.cameras)
    x, y, z = (rng.choice((-1, 1)) * rng.uniform(0.02, 0.05) for _ in range(3))
    return camera_fault(arena, name, CameraFault(turn_rad=(x, y, z)), suspected(name), 6.0, LATE_S)


def doubled_camera(arena: LiveArena, rng: random.Random) -> Fault:
    """The node of a second camera, at another place, publishes under the name of a camera."""
    name, view = rng.sample(arena.cameras, 2)
    twin = "twin"

    def report(seen: Evidence) -> str:
        health = seen.health(name)
        return seen.logged("two nodes", name) or ("status" if health and health.duplicate_publisher else "")

    def begin() -> None:
        arena.start_twin(name, view, twin)

    return Fault(name, begin, lambda: arena.programs.kill(twin), report, 6.0, LATE_S)


# Faults of robots.


def covered_robot(arena: LiveArena, rng: random.Random) -> Fault:
    return carried(arena, rng, moved_m=0.0)


def carried_robot(arena: LiveArena, rng: random.Random) -> Fault:
    return carried(arena, rng, moved_m=0.25)


def carried(arena: LiveArena, rng: random.Random, moved_m: float) -> Fault:
    """A robot is covered for some seconds, and carried to another place during that time."""
    name, seconds = rng.choice(arena.world.names), rng.uniform(1.5, 3.0)  # a status is sent every second

    def begin() -> None:
        old, now_ns = arena.world.events.get(name), arena.clock.now_ns()
        place = old.after if old else (0.0, 0.0, 0.0)
        x, y = (rng.uniform(-moved_m, moved_m) for _ in range(2))
        new = (x, y, rng.uniform(0, moved_m)) if moved_m else place
        until_ns = now_ns + round(seconds * 1e9)
        arena.cover(
            RobotEvent(robot=name, hidden_from_ns=now_ns, hidden_until_ns=until_ns, before=place, after=new)
        )

    def report(seen: Evidence) -> str:
        state = seen.robot(name)
        return f"status: {state}" if state in ("lost", "coasting") else ""

    return Fault(name, begin, nothing, report, seconds + 1.0, LONGEST_S, (name,))


# Faults of programs.


def killed_program(arena: LiveArena, rng: random.Random) -> Fault:
    names = [name for name in ("viewer", "recorder", "listener", "page") if name in arena.extra]
    name = rng.choice(names or ["server"])
    return Fault(name, lambda: arena.programs.kill(name), lambda: arena.start(name), None, 2.0)


def stopped_program(arena: LiveArena, rng: random.Random) -> Fault:
    """A reader that takes no messages must not slow the others down."""
    names = [name for name in ("viewer", "recorder", "listener", "page") if name in arena.extra]
    name = rng.choice(names or [arena.cameras[0]])
    pause = arena.programs.pause
    return Fault(name, lambda: pause(name, True), lambda: pause(name, False), None, 4.0)


def killed_server(arena: LiveArena, rng: random.Random) -> Fault:
    def begin() -> None:
        arena.programs.kill("server")
        arena.start("server")

    def report(seen: Evidence) -> str:
        return seen.logged("server:", "listens on")

    return Fault("server", begin, nothing, report, 5.0, 60.0)


def full_disk(arena: LiveArena, rng: random.Random) -> Fault:
    """The recorder's file can't grow; the recorder ends with one line, and a new one is started."""

    def begin() -> None:
        arena.programs.end("recorder")
        arena.start_recorder_on_full_disk(DISK_BYTES)

    def end() -> None:
        code = arena.programs.exit_code("recorder", 5.0)
        if code != 2:
            arena.programs.crashes.append(f"recorder on a full disk: exit code {code}")
        arena.start("recorder")

    return Fault("recorder", begin, end, lambda seen: seen.logged("recorder:", "error"), 5.0)


def changed_robots(arena: LiveArena, rng: random.Random) -> Fault:
    """A robot that does not exist is defined, and removed again."""
    answers: list[str] = []
    guest = next(iter(type(arena.load)(robots=1, markers=5, seed=rng.randrange(2, 999)).bodies.values()))

    def begin() -> None:
        try:
            answers.append(f"{len(arena.client.change_robots(define={'guest': guest}))} robots")
        except RoundelError as error:
            answers.append(str(error))

    def end() -> None:
        with contextlib.suppress(RoundelError):  # it was refused
            arena.client.change_robots(remove=["guest"])

    return Fault("guest", begin, end, lambda seen: answers[-1] if answers else "", 2.0)


def fuzz_burst(arena: LiveArena, rng: random.Random) -> Fault:
    arena.fuzz = Fuzz(messages=1500, rate=500.0, seed=rng.randrange(10**6))

    def report(seen: Evidence) -> str:
        n = seen.count("undecodable detections")
        return f"{n} undecodable detections" if n else ""

    def end() -> None:
        code = arena.programs.exit_code("fuzzer", 60.0)
        if code:
            arena.programs.crashes.append(f"fuzzer: exit code {code}")

    return Fault("fuzzer", lambda: arena.start("fuzzer"), end, report, 6.0, LATE_S)


def camera_fault(
    arena: LiveArena,
    name: str,
    fault: CameraFault,
    report: Callable[[Evidence], str],
    seconds: float,
    gap_s: float,
) -> Fault:
    """A fault of a simulated camera that goes on running."""

    def begin() -> None:
        arena.place(name, replace(fault, since_ns=arena.clock.now_ns()))

    return Fault(name, begin, lambda: arena.place(name, CameraFault()), report, seconds, gap_s)


KINDS: dict[str, tuple[int, Callable[[LiveArena, random.Random], Fault]]] = {  # weights
    "camera killed": (3, killed_camera),
    "camera stopped": (3, stopped_camera),
    "camera silent": (3, silent_camera),
    "camera frozen": (3, frozen_camera),
    "camera black": (2, black_camera),
    "camera bright": (2, bright_camera),
    "false roundels": (3, false_roundels),
    "frames lost": (3, lost_frames),
    "frames late": (3, late_frames),
    "frames swapped": (3, swapped_frames),
    "frames doubled": (3, doubled_frames),
    "clock stepped": (4, stepped_clock),
    "clock drifts": (3, drifting_clock),
    "camera moved": (3, moved_camera),
    "name used twice": (3, doubled_camera),
    "robot covered": (4, covered_robot),
    "robot carried": (4, carried_robot),
    "reader killed": (2, killed_program),
    "reader stopped": (2, stopped_program),
    "server killed": (2, killed_server),
    "disk full": (2, full_disk),
    "robots changed": (2, changed_robots),
    "fuzz": (2, fuzz_burst),
}

VIRTUAL = (  # kinds that need no programs besides cameras and server
    "camera silent",
    "camera frozen",
    "false roundels",
    "frames lost",
    "frames late",
    "frames swapped",
    "frames doubled",
    "clock stepped",
    "clock drifts",
    "camera moved",
    "robot covered",
    "robot carried",
)
