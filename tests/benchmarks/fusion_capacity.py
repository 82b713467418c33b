# SPDX-License-Identifier: BSD-3-Clause
"""What one core holds: the server's path from a message's bytes to the poses' bytes, without the network.

A queue with one server is simulated with the processor times measured: a message arrives `DELAY_NS` after its exposure,
waits until those before it are done, and an instant's latency counts from the arrival of the message that completed it.
"""

import gc
import time
from dataclasses import dataclass

import numpy as np

from camera_node.messages import Detections, decode, encode
from fusion.health import memory_mb
from fusion.instants import Frame, Instants
from fusion.tracker import Tracker
from tests.benchmarks.fusion_load import Load

DELAY_NS = 5_000_000
START_S = 0.5  # in which robots are found


@dataclass(frozen=True)
class Capacity:
    """Processor time of an instant, its latency in the queue, the share of a core, and what was followed."""

    cost_ms: float
    p50_ms: float
    p99_ms: float
    cpu: float
    tracked: float
    grown_mb: float  # resident memory from the start to the end


def capacity(load: Load, seconds: float) -> Capacity:
    """Of a load that runs for `seconds`."""
    gc.collect()
    gc.freeze()  # as the server does
    tracker, instants = Tracker(load.rig, load.bodies), Instants(round(1e9 / load.hz))
    free_ns, busy_ns, latencies, costs, tracked, memory = 0.0, 0.0, [], [], [], 0.0
    first_ns = None
    for message in load.messages(seconds):
        data, arrival_ns = encode(message), message.t_ns + DELAY_NS
        first_ns = first_ns or arrival_ns
        counted = arrival_ns - first_ns > START_S * 1e9
        memory = memory or (memory_mb() if counted else 0.0)
        begun = time.process_time_ns()
        seen = decode(data, Detections)
        instants.add(Frame.of(seen, load.rig[seen.camera]))
        fused = [tracker.fuse(instant) for instant in instants.take(arrival_ns)]
        for done in fused:
            [encode(pose) for pose in done.poses], encode(done.markers)
        cost = time.process_time_ns() - begun
        told_ns = max(free_ns, arrival_ns) + cost if counted else arrival_ns
        for _ in fused:
            tracker.inspect()
        after = time.process_time_ns() - begun - cost
        free_ns = told_ns + after if counted else arrival_ns
        busy_ns += cost + after if counted else 0
        if fused and counted:
            latencies.append((told_ns - arrival_ns) * 1e-6)
            costs.append(cost * 1e-6)
            tracked += [np.mean([pose.state == "tracked" for pose in done.poses]) for done in fused]
    p50, p99 = np.percentile(latencies, [50, 99])
    cpu = busy_ns / ((seconds - START_S) * 1e9)
    found = float(np.mean(tracked)) * len(fused_names(tracker)) / len(load.bodies)
    return Capacity(float(np.median(costs)), p50, p99, cpu, found, memory_mb() - memory)


def fused_names(tracker: Tracker) -> list[str]:
    """The robots that were ever found."""
    return [name for name, status in zip(tracker.names, tracker.status, strict=True) if status is not None]
