# SPDX-License-Identifier: BSD-3-Clause
"""Clock faults between running programs: a camera's clock that drifts, and a system clock that is set."""

import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from camera_node.clocks.host_clock import unix_ahead_ns
from fusion.model.states import POSITION
from fusion.protocol.pose_messages import RobotPose
from tests.benchmarks.faults.arena import LiveArena, small_load
from tests.benchmarks.faults.judge import MAX_ERROR_M, MAX_SIGMAS
from tests.benchmarks.faults.world import CameraFault
from tests.fusion.moving_cameras import MOVING
from tests.fusion.settable_arena import error_m, running_arena
from tests.fusion.settable_clock import SettableClock
from tests.waiting import Inbox

SETTLED, WATCHED = 60, 90  # poses at 30 Hz before the first step, and after each
SETTLE_S, LOOK_S = 3.0, 0.05
REPORT_S = 30.0  # longest wait for the report of a drift
GRACE_S = 0.1  # after a step, in which poses may be wrong


@dataclass(frozen=True)
class Judged:
    """The tracked poses after a fault: how many, how many wrong, the largest error, and their share of all."""

    count: int
    wrong: int
    worst_m: float
    share: float


def set_system_clock(folder: Path, steps_s: tuple[float, ...]) -> list[Judged]:
    """Set the system clock of a server and its cameras to each step ahead of the true time, and judge the poses."""
    clock, ahead_ns, results = SettableClock(folder), unix_ahead_ns(), []
    with running_arena(folder, clock) as client:
        poses = Inbox()
        client.robot("a").on_pose(poses.put)
        if not poses.until(lambda items: sum(pose.state == "tracked" for pose in items) >= SETTLED):
            raise TimeoutError("the robot is not tracked")
        for step_s in steps_s:
            clock.set_ahead(step_s)
            n = len(poses.items)
            if not poses.until(lambda items, n=n: len(items) >= n + WATCHED):
                raise TimeoutError(f"no poses after a step of {step_s:g} s")
            results.append(_judge(poses.items[n:], ahead_ns))
    return results


def _judge(poses: list[RobotPose], ahead_ns: int) -> Judged:
    tracked = [pose for pose in poses if pose.state == "tracked"]
    errors = [error_m(pose, ahead_ns) for pose in tracked]
    wrong = [
        e > MAX_ERROR_M and _sigmas(p, ahead_ns) > MAX_SIGMAS for p, e in zip(tracked, errors, strict=True)
    ]
    return Judged(len(tracked), sum(wrong), max(errors, default=np.nan), len(tracked) / len(poses))


def _sigmas(pose: RobotPose, ahead_ns: int) -> float:
    _, p = MOVING.motions["a"]((pose.t_ns - ahead_ns) * 1e-9)
    error = pose.position - p
    return float(np.sqrt(error @ np.linalg.solve(pose.covariance_matrix[POSITION, POSITION], error)))


@dataclass(frozen=True)
class DriftOutcome:
    """What a drift between programs gave.

    Attributes:
        reported_s: after its begin; infinite if not within `REPORT_S`.
        recovered_s: after its end, which is a step: the camera's stamps are used again; infinite if not by then.
        judged: the poses from its begin on.
        step_ms: of the stamps, at its end.
        others: other cameras that the server's log names.
    """

    reported_s: float
    recovered_s: float
    judged: Judged
    step_ms: float
    others: tuple[str, ...]


def drift_live(folder: Path, ppm: float, camera: str = "cam1") -> DriftOutcome:
    """Let the clock of a camera node drift until the server reports it, and set it right then."""
    with LiveArena(folder, small_load()) as arena:
        arena.wait_until_tracked()
        arena.wait(SETTLE_S)
        arena.judge.forget()
        arena.new_lines()
        lines: list[str] = []
        begun_s = time.monotonic()
        arena.place(camera, CameraFault(drift_ppm=ppm, since_ns=arena.clock.now_ns()))
        reported_s = _wait_for_line(arena, lines, f"camera {camera}: its clock drifts", REPORT_S)
        ended_s = time.monotonic()
        arena.place(camera, CameraFault())
        arena.wait(SETTLE_S)
        recovered_s = _wait_until_used(arena, camera, ended_s)
        lines += [line for _, line in arena.new_lines()]
        wrong = [p for p in arena.judge.wrong if not 0 <= p.received_s - ended_s < GRACE_S]
        judge = arena.judge
        share = judge.count / ((time.monotonic() - begun_s) * arena.load.hz * arena.load.robots)
        others = tuple(
            name for name in arena.cameras if name != camera and any(name in line for line in lines)
        )
    step_ms = 1e-3 * ppm * (ended_s - begun_s)
    return DriftOutcome(
        reported_s, recovered_s, Judged(judge.count, len(wrong), judge.largest_m, share), step_ms, others
    )


def _wait_for_line(arena: LiveArena, lines: list[str], text: str, timeout_s: float) -> float:
    """The seconds until the server logs a text; infinite without one."""
    begun_s = time.monotonic()
    while (elapsed_s := time.monotonic() - begun_s) < timeout_s:
        lines += [line for _, line in arena.new_lines()]
        if any(text in line for line in lines):
            return elapsed_s
        arena.wait(LOOK_S)
    return np.inf


def _wait_until_used(arena: LiveArena, camera: str, since_s: float) -> float:
    """The seconds since `since_s` until the status says that a camera's stamps are used."""
    while (elapsed_s := time.monotonic() - since_s) < 2 * SETTLE_S:
        health = arena.status.cameras.get(camera) if arena.status else None
        if health is not None and health.clock != "excluded" and health.assigned:
            return elapsed_s
        arena.wait(LOOK_S)
    return np.inf
