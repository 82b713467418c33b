# SPDX-License-Identifier: BSD-3-Clause
"""Whether memory stays flat at full load: `python -m tests.benchmarks.fusion_memory [--seconds 600]`.

Of simulated seconds, at whatever pace the machine has; takes about a core for 15 minutes. What grew at first is what
any program fills once (caches, the allocator's arenas); what still grows in the last part would go on.
"""

import gc
import sys

import numpy as np
import tyro

from camera_node.protocol.messages import encode
from fusion.server.server import collecting_between_frame_sets
from fusion.server.status import memory_mb
from tests.benchmarks.fusion_capacity import DELAY_NS, Queue, Series
from tests.benchmarks.fusion_load import START_NS, Load

EVERY_S = 10.0
SETTLED = 0.2  # share of the time that is left out of the slope


def main(seconds: float = 600.0, robots: int = 50) -> None:
    """Print resident memory and Python's allocated blocks every ten simulated seconds, and what grows a minute.

    Args:
        seconds: simulated.
        robots: of 4 markers each, before 8 free-running cameras at 60 Hz.
    """
    load, room = Load(robots=robots), round(seconds / EVERY_S) + 1
    times_s, memory, blocks = Series(room), Series(room), Series(room)
    with collecting_between_frame_sets():
        queue = Queue(load, seconds)
        for message in load.messages(seconds):
            at_s = (message.t_ns - START_NS) * 1e-9
            queue.step(encode(message), message.t_ns + DELAY_NS)
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
        f"{slope:.3f} MB and {per_min:.0f} blocks a minute, the first {SETTLED:.0%} left out; goal: flat, 0.1 MB"
    )


def grown(times_s: Series, values: Series) -> float:
    """A minute: the slope of a line through what came after the start."""
    t, y = (series.numbers[round(SETTLED * len(times_s)) :] for series in (times_s, values))
    return 60 * float(np.polyfit(t, y, 1)[0])


if __name__ == "__main__":
    tyro.cli(main)
