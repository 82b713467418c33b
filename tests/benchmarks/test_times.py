# SPDX-License-Identifier: BSD-3-Clause
"""Properties that are times. They hold on a machine that does nothing else: `pytest -m slow tests/benchmarks`."""

import time
from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pytest
import zenoh

from calib.live.rig_requests import set_rig
from calib.rig.rig import Rig
from camera_node.protocol.messages import decode
from fusion.model.robots import Robot, require_distinct
from fusion.protocol.pose_messages import FusedFrames, frames_key
from fusion.server.server import collecting_between_frame_sets
from tests.benchmarks.fusion_capacity import DELAY_NS, START_S, Queue, capacity
from tests.benchmarks.fusion_load import Load
from tests.fusion.serving import ARENA
from tests.fusion.unknown_robot import serving_an_unknown_robot
from tests.waiting import wait_for

pytestmark = pytest.mark.slow
LOAD = Load(robots=20, cameras=4, hz=30.0, crossing=True)
MAX_SLOWER, SECONDS = 1.5, 1.5
QUIET_SHARE = (
    0.15  # of a core that is used without false roundels, on any machine: its times are scaled to it
)


def test_false_roundels_do_not_delay_the_poses_of_tracked_robots():
    """By processor time, message by message in turns with the same robots without them; the robots are acquired first.
    Before: 1.3 times with 600, 90 times with 1,000."""
    pace = QUIET_SHARE / capacity(LOAD, SECONDS).cpu
    n_before = round(START_S * LOAD.hz * LOAD.cameras)
    plain = list(LOAD.messages(SECONDS))
    streams = [plain]
    for n in (600.0, 1000.0):
        crowded = list(replace(LOAD, false=n).messages(SECONDS))
        streams.append([*plain[:n_before], *crowded[n_before:]])
    queues = [Queue(LOAD, SECONDS, pace=pace) for _ in streams]
    with collecting_between_frame_sets():
        for messages in zip(*streams, strict=True):
            for queue, message in zip(queues, messages, strict=True):
                queue.step(message, message.t_ns + DELAY_NS)
    quiet, *others = [queue.sum_up(SECONDS) for queue in queues]
    for crowded in others:
        assert crowded.tracked == 1.0
        assert crowded.p50_ms < MAX_SLOWER * quiet.p50_ms


def test_the_comparison_of_seven_markers_is_fast():
    """Before: 17 ms a pair, 5,040 labelings of which few begin with equal distances."""
    rng = np.random.default_rng(3)
    shape = np.column_stack([rng.permuted(np.linspace(-0.4, 0.4, 7)), np.linspace(-0.4, 0.4, 7), np.zeros(7)])
    robots = {
        f"r{k}": Robot(diameter_m=0.04, markers=tuple(map(tuple, ((1 + 0.1 * k) * shape).tolist())))
        for k in range(25)
    }
    begun = time.process_time()
    require_distinct(robots)
    assert time.process_time() - begun < 2.0  # 0.1 s; it was 5 s


def test_a_rig_with_new_lenses_costs_no_frame_set(tmp_path: Path):
    """Before: their tables were made on the server's thread, and frame sets began again. The request takes as long as
    the tables; in that time frame sets follow one another, and none waits for all of them."""
    fused: list[tuple[float, int]] = []
    spare = msgspec.structs.replace(
        ARENA.cameras["cam0"], width=4000, height=3000, fx=2000.0, cx=2000.0, cy=1500.0
    )
    spares = {f"spare{k}": msgspec.structs.replace(spare, fy=2001.0 + k) for k in range(3)}

    def note(sample: zenoh.Sample) -> None:
        fused.append((time.monotonic(), decode(sample.payload.to_bytes(), FusedFrames).t_ns))

    with serving_an_unknown_robot(tmp_path) as (_, client):
        client.session.declare_subscriber(frames_key("test"), note)
        wait_for(lambda: len(fused) > 10)
        begun_s, n = time.monotonic(), len(fused)
        set_rig(client.session, "test", Rig(cameras={**ARENA.cameras, **spares}), "test")
        request_s, after = time.monotonic() - begun_s, len(fused)
        wait_for(lambda: len(fused) > after + 10)
    arrivals, times = np.array(fused[n - 1 :]).T
    steps = np.diff(times.astype(np.int64))
    assert steps.max() < 1.5 * np.median(steps)
    assert np.diff(arrivals).max() < request_s / 2
