# SPDX-License-Identifier: BSD-3-Clause
"""Acquisition of all robots by a server that restarts in a full arena: `python -m tests.benchmarks.fusion_cold`."""

import math
from dataclasses import dataclass

import numpy as np
import tyro

from fusion.server.server import collecting_between_frame_sets
from tests.benchmarks.fusion_capacity import DELAY_NS, Queue
from tests.benchmarks.fusion_load import START_NS, Load
from tests.benchmarks.fusion_swaps import WRONG_M


@dataclass(frozen=True)
class ColdStart:
    """Seconds until all robots are tracked (infinite if they never are), their largest share, and wrong poses."""

    seconds: float
    tracked: float
    wrong: int


def cold_start(load: Load, seconds: float) -> ColdStart:
    """The first `seconds` of a server, by processor time; see `Queue`."""
    queue = Queue(load, seconds)
    start_ns, done_s, most, wrong = 0, math.inf, 0, 0
    with collecting_between_frame_sets():
        for message in load.messages(seconds):
            arrival_ns = message.t_ns + DELAY_NS
            start_ns = start_ns or arrival_ns
            if not queue.step(message, arrival_ns):
                continue
            tracked = int(queue.tracker.table.tracked.sum())
            wrong += _count_wrong(queue)
            most = max(most, tracked)
            if tracked == load.robots and math.isinf(done_s):
                done_s = (queue.free_ns - start_ns) * 1e-9
    return ColdStart(done_s, most / load.robots, wrong)


def _count_wrong(queue: Queue) -> int:
    table = queue.tracker.table
    if table.t_ns is None:
        return 0
    truth = queue.load.paths.at((table.t_ns - START_NS) * 1e-9)
    off = np.linalg.norm(table.states.p - truth.p, axis=1) > WRONG_M
    return int((off & table.tracked).sum())


def main(robots: int = 200, seconds: float = 1.5, seeds: int = 3) -> None:
    """Print the time until all robots are tracked, for several arenas.

    Args:
        robots: of 4 markers each, before 8 cameras at 60 Hz.
        seconds: of the simulated start.
        seeds: arenas.
    """
    for seed in range(1, seeds + 1):
        got = cold_start(Load(robots, 4, 8, 60.0, seed=seed), seconds)
        print(
            f"seed {seed}: all tracked after {got.seconds:.2f} s, at most {got.tracked:.1%}; {got.wrong} wrong poses",
            flush=True,
        )


if __name__ == "__main__":
    tyro.cli(main)
