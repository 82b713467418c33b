# SPDX-License-Identifier: BSD-3-Clause
"""Hundreds of false roundels in all cameras, as of a texture: they are searched in portions. That this delays no pose
is a time: tests/benchmarks/test_times.py."""

from dataclasses import replace

import numpy as np

from fusion.model.frames import FrameSet
from fusion.tracking.marker_search import limit_of
from fusion.tracking.tracker import Tracker
from tests.benchmarks.fusion_load import Load

LOAD = Load(robots=20, cameras=4, hz=30.0, crossing=True)


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
