# SPDX-License-Identifier: BSD-3-Clause
"""Measures processor time, memory and frame rates of an arena's programs."""

import time
from collections.abc import Callable, Iterable, Mapping

import psutil

from web.state.feed import Feed

MIN_RATE = 0.9  # of a camera's frame rate, below which the machine is too slow for it


class ResourceUsage:
    """The use of resources since this object was created.

    Args:
        pids: returns the process ids of the programs, besides this one.
        feed: connected to the arena.

    Attributes:
        peak_bytes: the most memory that all programs had together in a call of `measure`.
    """

    def __init__(self, pids: Callable[[], Iterable[int]], feed: Feed) -> None:
        self.start_ns, self._start = time.time_ns(), time.monotonic()
        self._pids, self._feed = pids, feed
        self.peak_bytes = 0
        self._processor_s = self.measure()
        self._counts = feed.state().message_counts

    def seconds(self) -> float:
        """Return the measured time, above 0."""
        return max(1e-3, time.monotonic() - self._start)

    def measure(self) -> float:
        """Update `peak_bytes`; return the processor time of this process and the running programs, seconds."""
        seconds, resident = 0.0, 0
        for pid in (None, *self._pids()):  # None is this process
            try:
                process = psutil.Process(pid)
                with process.oneshot():
                    times = process.cpu_times()
                    seconds += times.user + times.system
                    resident += process.memory_info().rss
            except psutil.Error:  # it has ended
                continue
        self.peak_bytes = max(self.peak_bytes, resident)
        return seconds

    def frame_rates(self, cameras: Iterable[str]) -> dict[str, float]:
        """Return the frames per second of each camera."""
        counts = self._feed.state().message_counts - self._counts
        return {name: counts[f"frames {name}"] / self.seconds() for name in cameras}

    def summarize(self, cameras: Iterable[str]) -> list[str]:
        """Return the lines of the summary."""
        rates = ", ".join(f"{name} {rate:.1f}" for name, rate in self.frame_rates(cameras).items())
        processor = (self.measure() - self._processor_s) / self.seconds()
        memory = f"peak memory {self.peak_bytes / 1e6:.0f} MB"
        return [
            f"frames/s: {rates}",
            f"all programs: {100 * processor:.0f} % of one processor, {memory}",
        ]


def describe_overload(rates: Mapping[str, float], usual: Mapping[str, float]) -> list[str]:
    """A line on the camera that lacks most frames, if this machine is too slow to simulate the cameras.

    Args:
        rates: frames per second, by camera.
        usual: those of a machine that is fast enough.
    """
    name = min(rates, key=lambda camera: rates[camera] / usual[camera])
    if rates[name] >= MIN_RATE * usual[name]:
        return []
    frames = f"camera {name} sent {rates[name]:.1f} of {usual[name]:.1f} frames/s"
    return [f"this machine is too busy or too slow for the demo: {frames}; end other programs and try again"]
