# SPDX-License-Identifier: BSD-3-Clause
"""What one core holds: the server's path from a message's bytes to the poses' bytes, without the network.

A queue with one server is simulated with the processor times measured: a message arrives `DELAY_NS` after its exposure,
waits until those before it are done, and an instant's latency counts from the arrival of the message that completed it.
"""

import gc
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TypeVar

import msgspec
import numpy as np

from camera_node.messages import Detections, decode, encode
from fusion.health import memory_mb
from fusion.instants import Frame, Instants
from fusion.messages import Latency, RobotPose
from fusion.tracker import Tracker
from tests.benchmarks.fusion_load import Load

T = TypeVar("T")
DELAY_NS = 5_000_000
LATENCY = Latency(camera_ms=1.0, network_ms=1.0, wait_ms=1.0, fuse_ms=1.0, total_ms=4.0)
START_S = 0.5  # in which robots are found


@dataclass(frozen=True)
class Capacity:
    """Processor time of an instant in all, its latency in the queue, the share of a core, and what was followed."""

    cost_ms: float
    p50_ms: float
    p99_ms: float
    cpu: float
    tracked: float
    grown_mb_min: float  # slope of the resident memory, a line through one sample a second


def capacity(load: Load, seconds: float) -> Capacity:
    """Of a load that runs for `seconds`."""
    gc.collect()
    gc.freeze()
    gc.disable()  # as the server does
    try:
        return _Queue(load).run(seconds)
    finally:
        gc.enable()
        gc.unfreeze()


class _Queue:
    """The server's loop on the messages of a load: `free_ns` is when it is done with what came so far."""

    def __init__(self, load: Load) -> None:
        self.load = load
        self.tracker, self.instants = Tracker(load.rig, load.bodies), Instants(round(1e9 / load.hz))
        self.free_ns = self.busy_ns = 0
        self.latencies: list[float] = []
        self.tracked: list[float] = []

    def run(self, seconds: float) -> Capacity:
        """All messages of so many seconds; those of the first `START_S` are not counted."""
        first_ns, memory, collected_ns = 0, list[tuple[int, float]](), 0
        for message in self.load.messages(seconds):
            data, arrival_ns = encode(message), message.t_ns + DELAY_NS
            first_ns = first_ns or arrival_ns
            counted = arrival_ns - first_ns > START_S * 1e9
            if counted and not memory:
                memory.append((arrival_ns, memory_mb()))
                self.busy_ns, self.free_ns = 0, arrival_ns
                self.latencies, self.tracked = [], []
            if self.free_ns < arrival_ns:
                self._spend(self._anticipate)
            self.free_ns = max(self.free_ns, arrival_ns)
            self._take(data, arrival_ns)
            if arrival_ns - collected_ns > 1e9:
                self._spend(gc.collect)
                collected_ns = arrival_ns
                memory += [(arrival_ns, memory_mb())] if memory else []
        p50, p99 = np.percentile(self.latencies, [50, 99])
        cpu = self.busy_ns / ((seconds - START_S) * 1e9)
        found = float(np.mean(self.tracked)) * len(fused_names(self.tracker)) / len(self.load.bodies)
        cost_ms = 1e3 * cpu / self.load.hz
        return Capacity(cost_ms, p50, p99, cpu, found, _slope_mb_min(memory))

    def _take(self, data: bytes, arrival_ns: int) -> None:
        self._spend(lambda: self._add(data))
        for instant in self._spend(lambda: self.instants.take(arrival_ns)):
            poses = self._spend(lambda instant=instant: self._tell(self.tracker.advance(instant)))
            self.latencies.append((self.free_ns - arrival_ns) * 1e-6)
            told = {pose.robot for pose in poses}
            fused = self._spend(self.tracker.complete)
            if rest := [pose for pose in fused.poses if pose.robot not in told]:
                self._spend(lambda rest=rest: self._tell(rest))
                self.latencies[-1] = (self.free_ns - arrival_ns) * 1e-6
            self._spend(lambda fused=fused: encode(fused.markers))
            self._spend(self.tracker.inspect)
            self.tracked.append(float(np.mean([pose.state == "tracked" for pose in fused.poses])))

    def _anticipate(self) -> None:
        instant, owed = self.instants.open()
        if instant is not None:
            self.tracker.anticipate(instant, owed)

    def _add(self, data: bytes) -> None:
        seen = decode(data, Detections)
        self.instants.add(Frame.of(seen, self.load.rig[seen.camera]))

    def _tell(self, poses: Sequence[RobotPose]) -> Sequence[RobotPose]:
        for pose in poses:
            encode(msgspec.structs.replace(pose, latency=LATENCY))
        return poses

    def _spend(self, work: Callable[[], T]) -> T:
        """Do some work now, by the processor time that it takes."""
        begun = time.process_time_ns()
        done = work()
        cost = time.process_time_ns() - begun
        self.free_ns += cost
        self.busy_ns += cost
        return done


def _slope_mb_min(memory: list[tuple[int, float]]) -> float:
    """Of times (ns) and sizes (MB)."""
    t, size = np.array(memory, float).T
    return float(np.polyfit((t - t[0]) / 60e9, size, 1)[0]) if len(memory) > 2 else 0.0


def fused_names(tracker: Tracker) -> list[str]:
    """The robots that were ever found."""
    return [name for name, status in zip(tracker.names, tracker.status, strict=True) if status is not None]
