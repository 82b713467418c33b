# SPDX-License-Identifier: BSD-3-Clause
"""Memory growth at full load: `python -m tests.benchmarks.fusion_memory [--seconds 600]`.

Simulates the seconds as fast as the machine allows; takes about a core for 15 minutes. Caches and the arenas of the
allocator fill at first; growth in the last part would continue.
"""

import gc
import sys

import numpy as np
import tyro

from fusion.server.server import collecting_between_frame_sets
from fusion.server.server_statistics import memory_mb
from tests.benchmarks.fusion_capacity import DELAY_NS, Queue, Series
from tests.benchmarks.fusion_load import START_NS, Load

EVERY_S = 10.0
STARTUP = 0.2  # share of the time that the slope excludes


def main(seconds: float = 600.0, robots: int = 50) -> None:
    """Print resident memory and allocated Python blocks every ten simulated seconds, and their growth per minute.

    Args:
        seconds: simulated.
        robots: with 4 markers each, seen by 8 free-running cameras at 60 Hz.
    """
    load, room = Load(robots=robots), round(seconds / EVERY_S) + 1
    times_s, memory, blocks = Series(room), Series(room), Series(room)
    with collecting_between_frame_sets():
        queue = Queue(load, seconds)
        for message in load.messages(seconds):
            at_s = (message.t_ns - START_NS) * 1e-9
            queue.step(message, message.t_ns + DELAY_NS)
            if at_s >= (len(times_s) + 1) * EVERY_S:
                gc.collect()
                for series, value in (
                    (times_s, at_s),
                    (memory, memory_mb()),
                    (blocks, sys.getallocatedblocks()),
                ):
                    series.append(value)
                print(
                    f"{at_s:5.0f} s: {memory.numbers[-1]:.2f} MB, {blocks.numbers[-1]:.0f} blocks", flush=True
                )
    slope, per_min = grown(times_s, memory), grown(times_s, blocks)
    print(
        f"{slope:.3f} MB and {per_min:.0f} blocks per minute, without the first {STARTUP:.0%}; goal: 0.1 MB"
    )


def grown(times_s: Series, values: Series) -> float:
    """Growth per minute: the slope of a line through the values after the start."""
    t, y = (series.numbers[round(STARTUP * len(times_s)) :] for series in (times_s, values))
    return 60 * float(np.polyfit(t, y, 1)[0])


if __name__ == "__main__":
    tyro.cli(main)
