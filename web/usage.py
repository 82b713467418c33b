# SPDX-License-Identifier: BSD-3-Clause
"""Measures processor time, memory and frame rates of an arena's programs."""

import time
from collections.abc import Iterable

from web.feed import Feed
from web.processes import Processes


class ResourceUsage:
    """The use of resources since this object was created."""

    def __init__(self, processes: Processes, feed: Feed) -> None:
        self.start_ns, self._start = time.time_ns(), time.monotonic()
        self._processes, self._feed = processes, feed
        self._processor_s = processes.measure()
        self._counts = feed.state().message_counts

    def seconds(self) -> float:
        """Return the measured time, above 0."""
        return max(1e-3, time.monotonic() - self._start)

    def frame_rates(self, cameras: Iterable[str]) -> dict[str, float]:
        """Return the frames per second of each camera."""
        counts = self._feed.state().message_counts - self._counts
        return {name: counts[f"frames {name}"] / self.seconds() for name in cameras}

    def summarize(self, cameras: Iterable[str]) -> list[str]:
        """Return the lines of the summary."""
        rates = ", ".join(f"{name} {rate:.1f}" for name, rate in self.frame_rates(cameras).items())
        processor = (self._processes.measure() - self._processor_s) / self.seconds()
        memory = f"peak memory {self._processes.peak_bytes / 1e6:.0f} MB"
        return [
            f"frames/s: {rates}",
            f"all programs: {100 * processor:.0f} % of one processor, {memory}",
        ]
