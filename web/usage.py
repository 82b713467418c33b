# SPDX-License-Identifier: BSD-3-Clause
"""What the programs of an arena take of the machine, and how many frames they handle."""

import time
from collections.abc import Iterable

from web.feed import Feed
from web.processes import Processes


class Usage:
    """What the arena's programs take, from the moment that it is made."""

    def __init__(self, processes: Processes, feed: Feed) -> None:
        self.start_ns, self._start = time.time_ns(), time.monotonic()
        self._processes, self._feed = processes, feed
        self._processor_s = processes.processor_seconds()
        self._received = feed.latest().received

    def seconds(self) -> float:
        """How long it has been."""
        return max(1e-3, time.monotonic() - self._start)

    def note_memory(self) -> None:
        """Let the peak of the memory be seen."""
        self._processes.processor_seconds()

    def frame_rates(self, cameras: Iterable[str]) -> dict[str, float]:
        """Frames a second of each camera."""
        received = self._feed.latest().received - self._received
        return {name: received[f"frames {name}"] / self.seconds() for name in cameras}

    def summarise(self, cameras: Iterable[str]) -> list[str]:
        """The lines of a summary."""
        rates = ", ".join(f"{name} {rate:.1f}" for name, rate in self.frame_rates(cameras).items())
        processor = (self._processes.processor_seconds() - self._processor_s) / self.seconds()
        return [
            f"frames/s: {rates}",
            f"all programs: {100 * processor:.0f} % of one processor, "
            f"{self._processes.peak_bytes / 1e6:.0f} MB at most",
        ]
