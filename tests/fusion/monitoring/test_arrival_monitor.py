# SPDX-License-Identifier: BSD-3-Clause
"""Only changes relative to most cameras are evidence about a camera; the server or the network causes shared ones."""

from itertools import combinations

import numpy as np
import pytest

from fusion.monitoring.clocks.arrival_monitor import ArrivalMonitor
from tests.benchmarks.fusion_load import Load
from tests.fusion.clock_faults import GRACE_S, fuse, step

NAMES = tuple("abcd")
PERIOD_NS = 33_333_333
LEARNED = 40  # frames before the jump


def after_jumps(jumps_ms: dict[str, float], n_frames: int = 5) -> ArrivalMonitor:
    """Four cameras, some of whose stamps jump."""
    monitor, rng = ArrivalMonitor(NAMES), np.random.default_rng(3)
    for k in range(LEARNED + n_frames):
        for j, name in enumerate(NAMES):
            t_ns = k * PERIOD_NS + j * 7_000_000
            error_ns = round(jumps_ms.get(name, 0.0) * 1e6) if k >= LEARNED else 0
            monitor.observe(name, t_ns + error_ns, t_ns + 10_000_000 + round(rng.exponential(1e6)))
    return monitor


@pytest.mark.parametrize("jump_ms", [25.0, 400.0, -400.0])
@pytest.mark.parametrize("n", [1, 2, 3, 4])
def test_the_cameras_that_differ_from_most_jumped(jump_ms: float, n: int):
    """Of n cameras that jump alike, all did if they are half or less, the others by the opposite if they are more. But
    frames can't arrive before their stamps: three of four clocks of one hub that are ahead are wrong themselves."""
    for group in map(set, combinations(NAMES, n)):
        monitor = after_jumps(dict.fromkeys(group, jump_ms))
        jumped = n <= 2 or (n == 3 and jump_ms > 0)
        expected = group if jumped else set(NAMES) - group
        assert monitor.jumped == expected
        for name in expected:
            assert monitor.jump_ns(name) == pytest.approx(jump_ms * 1e6 * (1 if jumped else -1), abs=5e6)
        for name in expected:
            monitor.settle(name)
        assert not monitor.jumped


def test_cameras_that_jump_differently_are_no_majority():
    monitor = after_jumps({"a": 50.0, "b": -100.0, "c": 400.0})
    assert monitor.jumped == {"a", "b", "c"}


def test_a_pause_of_a_recording_without_arrival_times_excludes_no_camera():
    monitor = ArrivalMonitor(NAMES)
    for k in range(2 * LEARNED):
        for j, name in enumerate(NAMES):
            t_ns = k * PERIOD_NS + j * 7_000_000 + (10**9 if k >= LEARNED else 0)
            monitor.observe(name, t_ns, t_ns)
    assert not monitor.jumped


@pytest.mark.parametrize("step_s", [0.5, -0.1])
def test_a_jump_that_all_cameras_share_excludes_none(step_s: float):
    """Before: all were excluded, and without a frame set no search brought them back. Stamps in the future are
    corrected, others are used as they are. A robot that stands is where it was at any time."""
    load = Load(robots=1, cameras=4, hz=30.0, speed_m_s=0.0)
    outcome = fuse(load, 3.5, dict.fromkeys(load.rig, step(2.0, step_s)))
    assert outcome.wrong(2.0 + GRACE_S) == []
    (line,) = [line for _, line in outcome.log]
    assert line.startswith(f"the stamps of all cameras jumped by {1e3 * step_s:.0f} ms together")
    assert all(outcome.in_use_since_s(name) < 2.0 for name in load.rig)
    assert all(max(times) > 2.9 for times in outcome.used.values())


def test_two_cameras_that_jump_differently_come_back():
    """No frame set remains that could judge them, so the arrival decides after 2 s."""
    load = Load(robots=1, cameras=2, hz=30.0, speed_m_s=0.0)
    outcome = fuse(load, 5.0, {"cam0": step(2.0, 0.1), "cam1": step(2.0, -0.15)})
    assert outcome.wrong(2.0 + GRACE_S) == []
    for name in load.rig:
        assert outcome.reported_s(name) < 4.5
        assert max(outcome.used[name]) > 4.8
