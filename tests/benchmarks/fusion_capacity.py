# SPDX-License-Identifier: BSD-3-Clause
"""What one core holds: the server's path from a message's bytes to the poses' bytes, without the network.

A queue with one server is simulated with the processor times measured: a message arrives `DELAY_NS` after its exposure,
waits until those before it are done, and an instant's latency counts from the arrival of the message that completed it.
"""

import gc
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import islice
from typing import TypeVar

import msgspec
import numpy as np

from camera_node.arrays import Array
from camera_node.protocol.messages import Detections, decode, encode
from fusion.model.frames import CalibratedFrame
from fusion.protocol.messages import Latency, RobotPose, ShardPoses
from fusion.protocol.shards import Shard
from fusion.server.frame_synchronizer import FrameSynchronizer
from fusion.server.server import collecting_between_frame_sets
from fusion.tracking.tracker import Tracker
from tests.benchmarks.fusion_load import Load

T = TypeVar("T")
DELAY_NS = 5_000_000
LATENCY = Latency(camera_ms=1.0, network_ms=1.0, wait_ms=1.0, fuse_ms=1.0, total_ms=4.0)
START_S = 0.5  # in which robots are found
TURN_S = 0.25  # of a load, before the next has its turn


@dataclass(frozen=True, slots=True)
class Capacity:
    """Processor time of an instant in all, its latency in the queue, the share of a core, and what was followed.

    `quiet_ms` is the cost that one instant in twenty does not exceed: what is left where others take no caches.
    """

    cost_ms: float
    quiet_ms: float
    p50_ms: float
    p99_ms: float
    cpu: float
    tracked: float


def capacity(load: Load, seconds: float, shards: int = 1) -> Capacity:
    """Of a load that runs for `seconds`; of several shards, each a core of its own, the worst of each figure."""
    with collecting_between_frame_sets():
        queues = [Queue(load, seconds, Shard(k + 1, shards)) for k in range(shards)]
        for message in load.messages(seconds):
            data, arrival_ns = encode(message), message.t_ns + DELAY_NS
            told = [queue.step(data, arrival_ns) for queue in queues]
            for k, queue in enumerate(queues):
                queue.hear([message for other in (*told[:k], *told[k + 1 :]) for message in other])
    each = [queue.sum_up(seconds) for queue in queues]
    worst = {name: max(getattr(c, name) for c in each) for name in Capacity.__slots__}
    return Capacity(**worst | {"tracked": min(c.tracked for c in each)})


def compare(loads: Sequence[Load], seconds: float) -> list[Capacity]:
    """Of several loads, which take turns: what else the machine does meets all of them alike."""
    with collecting_between_frame_sets():
        queues = [Queue(load, seconds) for load in loads]
        streams = [load.messages(seconds) for load in loads]
        for _ in range(math.ceil(seconds / TURN_S)):
            for load, queue, stream in zip(loads, queues, streams, strict=True):
                for message in islice(stream, math.ceil(load.cameras * load.hz * TURN_S)):
                    queue.step(encode(message), message.t_ns + DELAY_NS)
    return [queue.sum_up(seconds) for queue in queues]


class Series:
    """Numbers, in memory that is taken before the first: what a benchmark keeps must not grow while it runs."""

    def __init__(self, room: int) -> None:
        self._numbers, self._n = np.full(room, np.nan), 0  # written, so that the memory is really taken

    def __len__(self) -> int:
        return self._n

    def append(self, number: float) -> None:
        self._numbers[self._n] = number
        self._n += 1

    def clear(self) -> None:
        self._n = 0

    @property
    def numbers(self) -> Array:
        return self._numbers[: self._n]


class Queue:
    """A server's loop on `seconds` of a load's messages: `free_ns` is when it is done with what came so far."""

    def __init__(self, load: Load, seconds: float, shard: Shard = Shard()) -> None:  # noqa: B008 frozen
        self.load = load
        self.tracker = Tracker(load.rig, load.bodies, shard=shard)
        self.instants = FrameSynchronizer(round(1e9 / load.hz))
        self.free_ns = self.busy_ns = self._first_ns = self._collected_ns = 0
        room = math.ceil((seconds + 1) * load.hz)
        self.latencies_ms, self.tracked = Series(room), Series(room)
        self._done_ns = Series(room)  # of processor time, at each instant's end
        self._warm = False

    def step(self, data: bytes, arrival_ns: int) -> list[bytes]:
        """A message comes; what other shards are told. What is done in the first `START_S` is not counted."""
        self._first_ns = self._first_ns or arrival_ns
        if not self._warm and arrival_ns - self._first_ns > START_S * 1e9:
            self._warm, self.busy_ns, self.free_ns = True, 0, arrival_ns
            for series in (self.latencies_ms, self.tracked, self._done_ns):
                series.clear()
        if self.free_ns < arrival_ns:
            self._spend(self._anticipate)
        self.free_ns = max(self.free_ns, arrival_ns)
        told = self._take(data, arrival_ns)
        if arrival_ns - self._collected_ns > 1e9:
            self._spend(gc.collect)
            self._collected_ns = arrival_ns
        return told

    def hear(self, messages: Sequence[bytes]) -> None:
        """Other shards' robots come."""
        self._spend(lambda: [self.tracker.follow(decode(message, ShardPoses)) for message in messages])

    def sum_up(self, seconds: float) -> Capacity:
        """What it took."""
        p50, p99 = np.percentile(self.latencies_ms.numbers, [50, 99])
        cpu = self.busy_ns / ((seconds - START_S) * 1e9)
        cost_ms, quiet_ms = (
            1e3 * cpu / self.load.hz,
            float(np.percentile(np.diff(self._done_ns.numbers), 5)) * 1e-6,
        )
        return Capacity(cost_ms, quiet_ms, p50, p99, cpu, float(np.mean(self.tracked.numbers)))

    def _take(self, data: bytes, arrival_ns: int) -> list[bytes]:
        self._spend(lambda: self._add(data))
        out: list[bytes] = []
        for instant in self._spend(lambda: self.instants.take(arrival_ns)):
            first = self._spend(lambda instant=instant: self.tracker.advance(instant))
            self._spend(lambda first=first: self._tell(first))
            done_ns = self.free_ns
            if self.tracker.shard.count > 1:
                out.append(self._spend(lambda: encode(self.tracker.tell())))
            fused = self._spend(self.tracker.complete)
            told = {pose.robot for pose in first}
            if rest := [pose for pose in fused.poses if pose.robot not in told]:
                self._spend(lambda rest=rest: self._tell(rest))
                done_ns = self.free_ns
            self.latencies_ms.append((done_ns - arrival_ns) * 1e-6)
            self._spend(lambda fused=fused: encode(fused.markers))
            self._spend(self.tracker.inspect)
            self._done_ns.append(self.busy_ns)
            count = sum(pose.state == "tracked" for pose in fused.poses)
            self.tracked.append(count / max(int(self.tracker.owned.sum()), 1))
        return out

    def _anticipate(self) -> None:
        instant, owed = self.instants.open()
        if instant is not None:
            self.tracker.anticipate(instant, owed)

    def _add(self, data: bytes) -> None:
        seen = decode(data, Detections)
        self.instants.add(CalibratedFrame.of(seen, self.load.rig[seen.camera]))

    def _tell(self, poses: Sequence[RobotPose]) -> list[bytes]:
        return [encode(msgspec.structs.replace(pose, latency=LATENCY)) for pose in poses]

    def _spend(self, work: Callable[[], T]) -> T:
        """Do some work now, by the processor time that it takes."""
        begun = time.process_time_ns()
        done = work()
        cost = time.process_time_ns() - begun
        self.free_ns += cost
        self.busy_ns += cost
        return done
