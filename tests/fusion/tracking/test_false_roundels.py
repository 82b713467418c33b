# SPDX-License-Identifier: BSD-3-Clause
"""Hundreds of false roundels in all cameras, as of a texture: they are searched in portions, which delays no pose."""

from dataclasses import replace

import numpy as np

from fusion.model.frames import FrameSet
from fusion.server.server import collecting_between_frame_sets
from fusion.tracking.marker_search import limit_of
from fusion.tracking.tracker import Tracker
from tests.benchmarks.fusion_capacity import DELAY_NS, START_S, Queue, capacity
from tests.benchmarks.fusion_load import Load

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


def test_the_work_of_a_frame_set_is_bounded_and_its_cameras_are_reported():
    """The number of pairs that are compared does not grow with the number of cameras or of false roundels."""
    for n in range(2, 17):
        assert limit_of(n, 200_000) ** 2 * n * (n - 1) / 2 <= 200_000
    crowded = replace(LOAD, false=600.0)
    frames = {frame.camera: frame for frame in crowded.frames(1 / LOAD.hz)}
    tracker = Tracker(LOAD.rig, LOAD.bodies)
    t_ns = round(np.mean([frame.t_ns for frame in frames.values()]))
    one = FrameSet(t_ns, (frames["cam0"], *(f for f in LOAD.frames(1 / LOAD.hz) if f.camera != "cam0")))
    assert tracker.track(one).crowded == ("cam0",)
    assert set(tracker.track(FrameSet(t_ns + 33_000_000, tuple(frames.values()))).crowded) == set(LOAD.rig)
