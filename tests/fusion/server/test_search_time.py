# SPDX-License-Identifier: BSD-3-Clause
"""A search for missing robots that takes longer than many frame sets, in virtual time."""

from dataclasses import replace
from pathlib import Path

from fusion.model.frames import FrameSet
from fusion.model.limits import Limits
from fusion.server.frame_synchronizer import SearchTurns
from fusion.tracking.acquisition import Acquisition
from fusion.tracking.tracker import Tracker
from tests.benchmarks.faults.arena import small_load
from tests.benchmarks.faults.virtual_arena import VirtualArena
from tests.benchmarks.fusion_accuracy import frame_sets
from tests.benchmarks.fusion_load import Load

SEARCH_S = 0.4  # longer than `Limits.lost_after_s`
assert Limits().lost_after_s < SEARCH_S


def test_a_slow_search_for_a_missing_robot_loses_no_other_robot(tmp_path: Path, monkeypatch):
    """Before, robots were lost while another was searched for: frame sets waited for each other's searches."""
    load = small_load(robots=4)
    absent = Load(robots=5, seed=7).bodies["r4"]
    with VirtualArena(tmp_path, load, robots=load.bodies | {"absent": absent}) as arena:
        search = Acquisition.acquire

        def slow_search(self, *args):
            arena.clock.t_ns += round(SEARCH_S * 1e9)
            return search(self, *args)

        arena.wait(1.0)
        monkeypatch.setattr(Acquisition, "acquire", slow_search)
        tracked, begun_s = [], arena.clock.now_s()
        while arena.clock.now_s() < begun_s + 1.5:
            arena.wait(0.1)
            tracker = arena.server.pipeline.tracker
            assert tracker is not None
            tracked.append(tracker.table.status[:4])
    assert all("lost" not in status for status in tracked)


def test_a_lagging_server_searches_once_a_second():
    turns, second = SearchTurns(), 1_000_000_000
    searched = [turns.decide(FrameSet(k * second // 10, ()), True).is_searched for k in range(20, 50)]
    assert 2 <= sum(searched) <= 3


def test_weak_fits_of_moving_robots_are_confirmed_by_searches_far_apart():
    """Six detections do not identify three markers at once: five searches do, between which a robot moves by 0.4 m."""
    load = Load(robots=2, markers=3, cameras=2, hz=30.0, missing=0.0, false=0.0)
    tracker = Tracker(load.rig, load.bodies)
    tracked = []
    for k, frame_set in enumerate(frame_sets(load, 3.2)):
        tracker.track(replace(frame_set, is_searched=k % 12 == 0))
        tracked.append(int(tracker.table.tracked.sum()))
    assert tracked[36] == 0
    assert tracked[-1] == load.robots
