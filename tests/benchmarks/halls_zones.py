# SPDX-License-Identifier: BSD-3-Clause
"""A hall in zones: `python -m tests.benchmarks.halls_zones [--zones 4 --robots 100]`, in virtual time on one core.

Robots drive through the whole hall. Prints the longest gap between a robot's poses, poses of two zones at once, errors
beside those of one server, and the processor time of a frame set by zone.
"""

import time
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
import tyro
from rich.console import Console
from rich.table import Table

from fusion.protocol.pose_messages import RobotPose
from tests.benchmarks.fusion_load import START_NS
from tests.benchmarks.fusion_swaps import WRONG_M
from tests.benchmarks.halls_load import Hall
from tests.fusion.zone_hall import VirtualHall, changes

CAMERAS = 8  # of a zone
START_S = 0.5  # for the acquisition of robots


@dataclass(frozen=True, slots=True)
class ZonedHall:
    """Figures of one run; the poses of the first half second do not count.

    Attributes:
        gap_ms: the longest time between two poses of a robot.
        doubles: poses between two of another zone that are a period apart; zones take turns at a handover, with frame
            sets at other times of the period.
        handovers: of all robots.
        wrong: tracked poses that are far from the truth.
        error_mm: RMS of the other tracked poses.
        cost_ms: processor time of a frame set, mean of the zones.
    """

    gap_ms: float
    doubles: int
    handovers: int
    wrong: int
    error_mm: float
    cost_ms: float


def run(load: Hall, zones: int, seconds: float) -> ZonedHall:
    """Track a load with so many servers."""
    names = list(load.rig)
    size = -(-len(names) // zones)
    parts = {f"z{k}": tuple(names[size * k : size * (k + 1)]) for k in range(zones)}
    hall = VirtualHall(parts, load.rig, load.bodies, round(1e9 / load.hz))
    frames = list(load.frames(seconds))
    begun = time.process_time()
    hall.run(frames)
    cost_ms = 1e3 * (time.process_time() - begun) / (seconds * load.hz * zones)
    streams = [
        [entry for entry in stream if entry[1].t_ns > START_NS + START_S * 1e9]
        for stream in hall.streams().values()
    ]
    steps_ns = [b[1].t_ns - a[1].t_ns for stream in streams for a, b in pairwise(stream)]
    tracked = [pose for stream in streams for _, pose in stream if pose.state == "tracked"]
    errors_m = np.array([_error_m(load, pose) for pose in tracked])
    is_wrong = errors_m > WRONG_M
    return ZonedHall(
        max(steps_ns) * 1e-6,
        sum(_count_doubles(stream, 1.5e9 / load.hz) for stream in streams),
        sum(map(changes, streams)),
        int(is_wrong.sum()),
        1e3 * float(np.sqrt(np.mean(errors_m[~is_wrong] ** 2))),
        cost_ms,
    )


def _count_doubles(stream: list[tuple[str, RobotPose]], within_ns: float) -> int:
    """How many poses of a robot stand between two of another zone that are so close to each other."""
    return sum(
        a[0] == c[0] != b[0] and c[1].t_ns - a[1].t_ns < within_ns
        for a, b, c in zip(stream, stream[1:], stream[2:], strict=False)
    )


def _error_m(load: Hall, pose: RobotPose) -> float:
    truth = load.paths.at((pose.t_ns - START_NS) * 1e-9).p[int(pose.robot[1:])]
    return float(np.linalg.norm(np.subtract(pose.position, truth)))


def main(zones: int = 4, robots: int = 40, seconds: float = 3.0) -> None:
    """Print the table.

    Args:
        zones: of 8 cameras each.
        robots: in the whole hall.
        seconds: of the run.
    """
    load = Hall(robots=robots, cameras=CAMERAS * zones, hz=30.0, speed_m_s=2.0, crossing=True)
    half = replace(load, cameras=CAMERAS * zones // 2, robots=robots // 2)
    table = Table(
        "", "gap, ms", "doubles", "handovers", "wrong poses", "error, mm", "frame set of a zone, ms"
    )
    for name, hall, n in (
        (f"{load.cameras} cameras, {robots} robots: one server", load, 1),
        (f"the same: {zones} zones", load, zones),
        (f"half the hall: {zones // 2} zones", half, zones // 2),
    ):
        got = run(hall, n, seconds)
        figures = (
            f"{got.gap_ms:.1f}",
            got.doubles,
            got.handovers,
            got.wrong,
            f"{got.error_mm:.2f}",
            f"{got.cost_ms:.1f}",
        )
        table.add_row(name, *map(str, figures))
    Console(width=150).print(table)


if __name__ == "__main__":
    tyro.cli(main)
