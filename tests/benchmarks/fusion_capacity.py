# SPDX-License-Identifier: BSD-3-Clause
"""Capacity of one core: `python -m tests.benchmarks.fusion_capacity [--robots 60 100 150]`, 15 s a load.

The server's path from the bytes of messages to the bytes of poses, without the network, and without the process that
judges the cameras.

Simulates a queue with one server by measured processor times: a message arrives `DELAY_NS` after its exposure and waits
until the earlier ones are done. The latency of a frame set counts from the arrival of the message that completes it.
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
import tyro

from camera_node.foundation.arrays import Array
from camera_node.foundation.background_process import BackgroundProcess
from camera_node.protocol.messages import Detections, Keys, encode
from fusion.model.frames import FrameSet
from fusion.protocol.pose_messages import Latency, RobotPose, TrackingState
from fusion.server.frame_synchronizer import FrameSynchronizer
from fusion.server.ingest import Ingest
from fusion.server.server import MAX_LAG_NS, collecting_between_frame_sets
from fusion.server.server_statistics import PipelineStatus, ServerStatistics
from fusion.tracking.association import AssociatedFrames
from fusion.tracking.tracker import WORTH, Tracker, Update
from tests.benchmarks.fusion_load import Load

T = TypeVar("T")
DELAY_NS = 5_000_000
P50_MS = 5.0  # goal of issue 16
LATENCY = Latency(camera_ms=1.0, network_ms=1.0, wait_ms=1.0, fuse_ms=1.0, total_ms=4.0)
START_S = 0.5  # for the acquisition of robots
TURN_S = 0.25  # of a load before the next load's turn


@dataclass(frozen=True, slots=True)
class Capacity:
    """Mean processor time of a frame set, its latency in the queue, the share of a core, and of robots tracked.

    `quiet_ms` is the 5th percentile of the processor time: the cost with warm caches.
    """

    cost_ms: float
    quiet_ms: float
    p50_ms: float
    p99_ms: float
    cpu: float
    tracked: float


def capacity(load: Load, seconds: float) -> Capacity:
    """Measure a load for `seconds`."""
    with collecting_between_frame_sets():
        queue = Queue(load, seconds)
        for message in load.messages(seconds):
            queue.step(message, message.t_ns + DELAY_NS)
    return queue.sum_up(seconds)


def compare(loads: Sequence[Load], seconds: float) -> list[Capacity]:
    """Measure several loads in turns, so that other processes affect all of them equally."""
    with collecting_between_frame_sets():
        queues = [Queue(load, seconds) for load in loads]
        streams = [load.messages(seconds) for load in loads]
        for _ in range(math.ceil(seconds / TURN_S)):
            for load, queue, stream in zip(loads, queues, streams, strict=True):
                for message in islice(stream, math.ceil(load.cameras * load.hz * TURN_S)):
                    queue.step(message, message.t_ns + DELAY_NS)
    return [queue.sum_up(seconds) for queue in queues]


class Series:
    """A list of numbers in preallocated memory: the memory of a benchmark must not grow while it runs."""

    def __init__(self, room: int) -> None:
        self._numbers, self._n = np.full(room, np.nan), 0  # written, so that the memory is resident

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
    """The loop of a server on the messages of a load; `free_ns` is when it has processed them.

    Args:
        load: robots and cameras.
        seconds: of the load.
        pace: factor of the measured processor times, to simulate a faster or a slower machine.
        rate_hz: of frame sets; that of the cameras unless given.
        use: is called with the time of a publication, and its poses, after the first `START_S` seconds.
    """

    def __init__(
        self,
        load: Load,
        seconds: float,
        pace: float = 1.0,
        rate_hz: float | None = None,
        use: Callable[[int, Sequence[RobotPose]], None] | None = None,
    ) -> None:
        self.load, self.pace, self._use = load, pace, use
        self._keys, self._statistics = Keys("load"), ServerStatistics()
        self._ingest = Ingest(self._keys, self._statistics)
        self.tracker = Tracker(load.rig, load.bodies)
        self.tracker.judge_cameras_in(BackgroundProcess())
        rate_hz = rate_hz or load.hz
        self.synchronizer = FrameSynchronizer(round(1e9 / rate_hz))
        self.free_ns = self.busy_ns = self._first_ns = self._collected_ns = 0
        room = math.ceil((seconds + 1) * rate_hz)
        self.latencies_ms, self.tracked = Series(room), Series(room)
        self._done_ns = Series(room)  # processor time at the end of each frame set
        self._warm = False
        self._early: AssociatedFrames | None = None

    def step(self, message: Detections, arrival_ns: int) -> bool:
        """Process a message; return whether that completed a frame set. The first `START_S` seconds do not count."""
        data, key = encode(message), self._keys.detections(message.camera)
        self._first_ns = self._first_ns or arrival_ns
        if not self._warm and arrival_ns - self._first_ns > START_S * 1e9:
            self._warm, self.busy_ns, self.free_ns = True, 0, arrival_ns
            for series in (self.latencies_ms, self.tracked, self._done_ns):
                series.clear()
        if self.free_ns < arrival_ns:
            self._spend(self._associate_early)
        self.free_ns = max(self.free_ns, arrival_ns)
        is_dropped = self.free_ns > arrival_ns + MAX_LAG_NS
        is_complete = not is_dropped and self._take(data, key, arrival_ns)
        if arrival_ns - self._collected_ns > 1e9:
            self._spend(gc.collect)
            self._spend(lambda: self._statistics.report(arrival_ns, PipelineStatus()))
            self._collected_ns = arrival_ns
        return is_complete

    def sum_up(self, seconds: float) -> Capacity:
        """The measured figures."""
        p50, p99 = np.percentile(self.latencies_ms.numbers, [50, 99])
        cpu = self.busy_ns / ((seconds - START_S) * 1e9)
        cost_ms, quiet_ms = (
            1e3 * cpu / self.load.hz,
            float(np.percentile(np.diff(self._done_ns.numbers), 5)) * 1e-6,
        )
        return Capacity(cost_ms, quiet_ms, p50, p99, cpu, float(np.mean(self.tracked.numbers)))

    def _take(self, data: bytes, key: str, arrival_ns: int) -> bool:
        self._spend(lambda: self._add(data, key, arrival_ns))
        frame_sets = self._spend(lambda: self.synchronizer.take(arrival_ns))
        for frame_set in frame_sets:
            update = self._spend(lambda frame_set=frame_set: self._update(frame_set))
            first = list(update.poses.values())
            self._spend(lambda first=first: self._encode(first))
            done_ns = self.free_ns
            if self._use is not None and self._warm:
                self._use(done_ns, first)
            result = self._spend(lambda update=update: self.tracker.finish(update))
            published = {pose.robot for pose in first}
            if rest := [pose for pose in result.poses if pose.robot not in published]:
                self._spend(lambda rest=rest: self._encode(rest))
                done_ns = self.free_ns
            self.latencies_ms.append((done_ns - arrival_ns) * 1e-6)
            self._spend(lambda result=result: encode(result.markers))
            self._spend(lambda frame_set=frame_set, result=result: self.tracker.check_extrinsics(frame_set))
            self._done_ns.append(self.busy_ns)
            states: dict[str, TrackingState] = {pose.robot: pose.state for pose in result.poses}
            self._statistics.count_frame_set(result.cameras, states, None)
            count = sum(state == "tracked" for state in states.values())
            self.tracked.append(count / max(len(self.tracker.table.names), 1))
        return bool(frame_sets)

    def _update(self, frame_set: FrameSet) -> Update:
        associated = self.tracker.associate(self.tracker.predict(frame_set.t_ns, self._early), frame_set)
        return self.tracker.update(associated, frame_set)

    def _associate_early(self) -> None:
        """As `TrackingPipeline` does."""
        if (t_ns := self.synchronizer.open_ns) is not None:
            self._early = self.tracker.predict(t_ns, self._early)
            opened = self.synchronizer.opened(self._early.association.n_frames, WORTH)
            self._early = self.tracker.associate(self._early, opened) if opened else self._early

    def _add(self, data: bytes, key: str, arrival_ns: int) -> None:
        """As `Server` does."""
        frame = self._ingest.receive(data, key, arrival_ns, self.load.rig)
        if frame is not None and (frame := self.tracker.admit(frame)) is not None:
            if self.synchronizer.add(frame):
                self._statistics.note_on_time(frame.camera)
            else:
                late_ms = (arrival_ns - frame.t_ns) * 1e-6
                self._statistics.note_late(frame.camera, late_ms, self.synchronizer.limit_ns * 1e-6)

    def _encode(self, poses: Sequence[RobotPose]) -> list[bytes]:
        return [encode(msgspec.structs.replace(pose, latency=LATENCY)) for pose in poses]

    def _spend(self, work: Callable[[], T]) -> T:
        """Do some work and measure its processor time."""
        begun = time.process_time_ns()
        done = work()
        cost = time.process_time_ns() - begun
        self.free_ns += round(cost * self.pace)
        self.busy_ns += cost
        return done


def main(robots: tuple[int, ...] = (60, 100, 150), seconds: float = 4.0) -> int:
    """Print the capacity of one core; exit code 1 if one of the loads is too much for it.

    Args:
        robots: of 4 markers each, before 8 cameras at 60 Hz; one load for each number.
        seconds: of each load.
    """
    is_enough = True
    for n in robots:
        got = capacity(Load(n, 4, 8, 60.0), seconds)
        is_enough &= got.cpu < 1 and got.p50_ms < P50_MS and got.tracked > 0.99
        print(
            f"{n} robots: {got.cpu:.0%} of a core ({got.quiet_ms * 60 / 1e3:.0%} undisturbed), "
            f"p50 {got.p50_ms:.1f} ms, p99 {got.p99_ms:.1f} ms, {got.tracked:.1%} tracked",
            flush=True,
        )
    return int(not is_enough)


if __name__ == "__main__":
    raise SystemExit(tyro.cli(main))
