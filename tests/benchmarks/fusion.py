# SPDX-License-Identifier: BSD-3-Clause
"""What an instant costs to fuse, by robots and cameras: `python -m tests.benchmarks.fusion`, processor time."""

import time

import numpy as np

from fusion.instants import Instants
from fusion.robots import Robot, require_distinct
from fusion.tracker import Tracker
from tests.fusion.synthetic import PERIOD_NS, Arena, line, ring

FRAMES, START = 60, 10  # instants timed after those in which robots are found
CASES = ((1, 4), (3, 4), (10, 4), (10, 8))


def robots(n: int) -> dict[str, Robot]:
    """Triangles of different shapes."""
    turn = np.array([0.0, 2.2, 4.0])
    reach = [np.array([0.10 + 0.025 * (k % 4), 0.12, 0.14 + 0.03 * (k // 4)]) for k in range(n)]
    corners = [np.column_stack([r * np.cos(turn), r * np.sin(turn), 0 * r]) for r in reach]
    return {
        f"r{k}": Robot(diameter_m=0.08, markers=tuple(map(tuple, c.tolist()))) for k, c in enumerate(corners)
    }


def arena(n_robots: int, n_cameras: int) -> Arena:
    """Robots in two rows that turn on the spot."""
    declared = robots(n_robots)
    require_distinct(declared)
    places = [(0.5 * (k % 5) - 1.0, 0.6 * (k // 5) - 0.3, 0.1) for k in range(n_robots)]
    motions = {name: line(at, turn=(0, 0, 1.0)) for name, at in zip(declared, places, strict=True)}
    phases = tuple(np.linspace(-0.4, 0.4, n_cameras))
    return Arena(declared, motions, ring(n_cameras), phases, sigma_px=0.05)


def main() -> None:
    """Print the milliseconds of an instant, and how many robots were followed on average."""
    for n_robots, n_cameras in CASES:
        scene = arena(n_robots, n_cameras)
        instants, tracker = Instants(PERIOD_NS), Tracker(scene.cameras, scene.robots)
        for frame in scene.frames(FRAMES + START):
            instants.add(frame)
        closed = instants.finish()
        for instant in closed[:START]:
            tracker.fuse(instant)
        start = time.process_time()
        fused = [tracker.fuse(instant) for instant in closed[START:-1]]
        cost = (time.process_time() - start) / len(fused) * 1e3
        followed = np.mean([sum(pose.state == "tracked" for pose in f.poses) for f in fused])
        print(
            f"{n_robots:2} robots x {n_cameras} cameras: {cost:5.2f} ms an instant ({followed:.1f} tracked)"
        )


if __name__ == "__main__":
    main()
