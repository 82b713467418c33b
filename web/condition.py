# SPDX-License-Identifier: BSD-3-Clause
"""The condition of an arena in one line: green, amber or red, with what to do; and the operator's next step."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

import numpy as np

from calib.rig.rig import Rig
from camera_node.protocol.presence import NO_SERVER, no_such_arena
from fusion.protocol.arena_health import describe_contradiction
from fusion.protocol.pose_messages import FusionStatus
from web.state.feed import ArenaState
from web.tables import STALE_S, camera_silence_s, describe_silence, tabulate_cameras, tabulate_robots

Level = Literal["ok", "warn", "bad", "wait"]
Step = Literal["cameras", "calibrate", "floor", "robots", "run"]
CONNECT_S = 5.0  # after the start of the page, while the absence of a server is no fault


@dataclass(frozen=True)
class Condition:
    """A level (a key of `web.html_tables.COLOURS`) and a sentence."""

    level: Level
    text: str


def assess(state: ArenaState, endpoint: str, calibrating: str = "") -> Condition:
    """The worst fault of an arena, or its figures if it has none.

    Args:
        state: of a feed.
        endpoint: where the server is expected.
        calibrating: what the operator should do in a calibration that began on this page; empty for none.
    """
    if is_relative(state):
        return _relative_condition(state)
    faults = [
        *_server_faults(state, endpoint),
        *_contradictions(state),
        *_camera_faults(state, calibrating),
        *_robot_faults(state),
    ]
    for level in ("wait", "bad", "warn"):
        found = [fault for fault in faults if fault.level == level]
        if found:
            more = f" (and {len(faults) - 1} more)" if len(faults) > 1 else ""
            return Condition(level, found[0].text + more)
    return Condition("ok", _figures(state))


def is_relative(state: ArenaState) -> bool:
    """Whether cameras locate roundels by themselves, without a server: nothing is to be calibrated or declared."""
    located = any(state.age_s(timed) <= STALE_S for timed in state.relative.values())
    return located and state.status is None and not state.server_alive


def _relative_condition(state: ArenaState) -> Condition:
    for fault in _silent_cameras(state):
        return fault
    n = sum(state.age_s(timed) <= STALE_S for timed in state.relative.values())
    verb = "locates" if n == 1 else "locate"
    return Condition("ok", f"{_count(n, 'camera')} {verb} roundels relative to themselves, without a server")


def next_step(state: ArenaState) -> Step:
    """What the operator should do next, in the order of the work."""
    if is_relative(state):
        return "run"
    if not any(camera_silence_s(state, name) is None for name in state.cameras):
        return "cameras"
    if state.rig is None or not state.rig.placed():
        return "calibrate"
    if state.status is None or state.declared_robots():
        return "run"
    return "floor" if lacks_floor(state.rig) else "robots"


def lacks_floor(rig: Rig) -> bool:
    """Whether a wand placed the cameras, which defines neither floor nor origin, and nothing else has defined them."""
    return "grade" in rig.calibration and "world" not in rig.calibration


def _server_faults(state: ArenaState, endpoint: str) -> Iterator[Condition]:
    """At most one: without a server nothing else is known."""
    age_s = state.age_s(state.status)
    if state.server_alive and age_s <= STALE_S:
        return
    if state.status is None and state.now_s - state.started_s < CONNECT_S:
        yield Condition("wait", f"connecting to {endpoint} ...")
    elif state.server_alive and state.status is None:
        yield Condition("wait", "connected; waiting for the server's first status")
    elif state.status is None:
        cause = no_such_arena(state.arena, state.other_arenas) if state.other_arenas else NO_SERVER
        yield Condition("bad", f"no server at {endpoint}: {cause}")
    else:
        yield Condition("bad", f"the server is silent for {age_s:.0f} s: check that it runs at {endpoint}")


def _contradictions(state: ArenaState) -> Iterator[Condition]:
    """Cameras and robots whose residuals contradict the claimed uncertainty: poses are wrong by more than they say."""
    if state.status is not None and state.age_s(state.status) <= STALE_S:
        for contradiction in state.status.message.contradictions:
            yield Condition("warn", describe_contradiction(contradiction))


def _camera_faults(state: ArenaState, calibrating: str) -> Iterator[Condition]:
    if state.age_s(state.status) > STALE_S:
        return
    yield from _silent_cameras(state)
    if not state.cameras:
        yield Condition("warn", "no camera sends anything: start one with roundel camera")
        return
    if calibrating:
        yield Condition("warn", calibrating)
    elif state.rig is None or not state.rig.placed():
        yield Condition("warn", "the cameras are not calibrated: open Calibrate and record a wand")
    if state.rig is None or not state.rig.placed():
        return
    for row in tabulate_cameras(state).rows:
        if row.note and camera_silence_s(state, row.cells[0]) is None:
            yield Condition("warn", f"camera {row.cells[0]}: {row.note}")


def _silent_cameras(state: ArenaState) -> Iterator[Condition]:
    for name in sorted(state.cameras):
        if (seconds := camera_silence_s(state, name)) is not None:
            yield Condition("bad", f"camera {name} {describe_silence(seconds)}")


def _robot_faults(state: ArenaState) -> Iterator[Condition]:
    if state.rig is None or state.age_s(state.status) > STALE_S:
        return
    rows = tabulate_robots(state).rows
    if not rows and lacks_floor(state.rig):
        yield Condition(
            "warn",
            "floor and origin are not defined: stand the wand on the floor, or lay the L-frame on it, and open Floor "
            "and origin in Calibrate",
        )
    elif not rows:
        yield Condition("warn", "no robot is declared: open Robots and create one")
    for row in rows:
        if row.cells[1] != "tracked":
            reason = f": {row.note}" if row.note else ""
            yield Condition("warn", f"robot {row.cells[0]} is {row.cells[1]}{reason}")
        elif row.note:
            yield Condition("warn", f"robot {row.cells[0]}: {row.note}")


def _figures(state: ArenaState) -> str:
    if state.status is None:
        return "no data"
    status: FusionStatus = state.status.message
    tracked = sum(tracking == "tracked" for tracking in status.robots.values())
    latency = (
        f", latency {status.latency_ms:.0f} ms"
        if status.latency_ms is not None and np.isfinite(status.latency_ms)
        else ""
    )
    cameras = _count(len(state.cameras), "camera")
    robots = f"{_count(tracked, 'robot')} tracked"
    rate = f", {status.frame_sets_per_s:.0f} poses/s" if tracked else ""
    return f"{cameras}, {robots}{rate}{latency}"


def _count(n: int, noun: str) -> str:
    return f"{n} {noun}{'' if n == 1 else 's'}"
