# SPDX-License-Identifier: BSD-3-Clause
"""Properties of instants. Time is what the tests say it is."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from camera_node.detection.roundels import Roundels
from fusion.model.frames import CalibratedFrame, FrameSet
from fusion.server.frame_synchronizer import SILENT_NS, FrameSynchronizer
from fusion.tracking.tracker import Limits

PERIOD = 33_333_333
MS = 1_000_000
TICK = 5 * MS
START = 10**12
NOTHING = Roundels.from_points(np.empty((0, 2)), 0.3)
LATENESS = round(Limits().lateness_ms * MS)
Arrivals = list[tuple[int, CalibratedFrame]]


def frame(camera: str, t_ns: int) -> CalibratedFrame:
    return CalibratedFrame(camera, START + t_ns, NOTHING, np.empty((2, 0)), np.empty((2, 2, 0)))


def row(camera: str, n: int, phase: float = 0.0, delay: int = 0, period: int = PERIOD) -> Arrivals:
    """`n` frames of a camera and when they arrive."""
    return [(START + delay + round(t), frame(camera, round(t))) for t in (np.arange(n) + phase) * period]


def play(instants: FrameSynchronizer, arrivals: Arrivals) -> list[tuple[int, FrameSet]]:
    """When each instant closed, if asked at every arrival and tick; the last ones, left to `finish`, at 0."""
    arrivals = sorted(arrivals, key=lambda arrival: arrival[0])
    closed, now = [], arrivals[0][0]
    for arrival_ns, came in arrivals:
        while now < arrival_ns:
            now = min(now + TICK, arrival_ns)
            closed += [(now, instant) for instant in instants.take(now)]
        instants.add(came)
        closed += [(now, instant) for instant in instants.take(now)]
    return closed + [(0, instant) for instant in instants.finish()]


def used(closed: list[tuple[int, FrameSet]]) -> list[tuple[str, int]]:
    return sorted((f.camera, f.t_ns) for _, instant in closed for f in instant.frames)


def sent(arrivals: Arrivals) -> list[tuple[str, int]]:
    return sorted((f.camera, f.t_ns) for _, f in arrivals)


def steps(closed: list[tuple[int, FrameSet]]) -> np.ndarray:
    return np.diff([instant.t_ns for _, instant in closed])


@settings(max_examples=50, deadline=None)
@given(
    phases=st.lists(st.floats(-0.5, 0.5), min_size=1, max_size=5),
    period=st.integers(10 * MS, 100 * MS),
)
def test_every_frame_is_in_the_nearest_instant_and_in_no_other(phases, period):
    """An instant does not wait for a frame that may as well be of the next: to a tenth of a period."""
    arrivals = [a for k, p in enumerate(phases) for a in row(f"cam{k}", 20, p, period=period)]
    instants = FrameSynchronizer(period)
    closed = play(instants, arrivals)
    assert used(closed) == sent(arrivals)
    off = [abs(f.t_ns - instant.t_ns) for _, instant in closed for f in instant.frames]
    assert max(off) <= 0.6 * period + 2
    assert (steps(closed) == period).all()
    assert sum(instants.late.values()) == 0


@settings(max_examples=50, deadline=None)
@given(
    phases=st.lists(st.floats(-0.5, 0.5), min_size=2, max_size=4),
    delays=st.lists(st.integers(0, 140), min_size=4),
)
def test_frames_within_the_bound_are_used_once(phases, delays):
    arrivals = [a for k, p in enumerate(phases) for a in row(f"cam{k}", 30, p, delays[k] * MS)]
    instants = FrameSynchronizer(PERIOD, LATENESS)
    assert used(play(instants, arrivals)) == sent(arrivals)
    assert sum(instants.late.values()) == 0


def test_cameras_all_100_ms_behind_are_fused_without_loss():
    """As cheap USB cameras are: every instant has a frame of each, and closes as soon as it does."""
    arrivals = [a for k, p in enumerate((0.0, 0.2, -0.3)) for a in row(f"cam{k}", 40, p, 100 * MS)]
    instants = FrameSynchronizer(lateness_ns=LATENESS)
    closed = play(instants, arrivals)
    assert used(closed) == sent(arrivals)
    assert {len(instant.frames) for _, instant in closed[1:-1]} == {3}
    assert max(now - instant.t_ns for now, instant in closed[10:]) < 100 * MS + PERIOD


@pytest.mark.parametrize(("delay_ms", "lost"), [(100, 0), (400, 1)])
def test_a_frame_that_missed_its_instant_is_used_at_its_own_time_or_counted(delay_ms, lost):
    arrivals = row("a", 40) + row("b", 40, 0.1)
    late_ns, late = arrivals[60]
    arrivals[60] = (late_ns + delay_ms * MS, late)
    instants = FrameSynchronizer(PERIOD, LATENESS)
    closed = play(instants, arrivals)
    where = [instant for _, instant in closed if any(f is late for f in instant.frames)]
    assert len(where) == 1 - lost
    assert all(PERIOD < instant.t_ns - late.t_ns < LATENESS + PERIOD for instant in where)
    assert instants.late == {"a": 0, "b": lost}


def test_a_silent_camera_is_waited_for_to_the_bound_and_not_once_it_is_gone():
    arrivals = row("a", 90) + row("b", 30, 0.1)
    silent_ns = arrivals[-1][1].t_ns
    closed = play(FrameSynchronizer(PERIOD, LATENESS), arrivals)[:-1]
    waited = np.array(
        [(instant.t_ns - silent_ns, now - instant.t_ns - PERIOD // 2) for now, instant in closed]
    )
    before = waited[:, 0] < 0
    missing = (waited[:, 0] > PERIOD) & (waited[:, 0] < SILENT_NS - LATENESS - PERIOD)
    gone = waited[:, 0] > SILENT_NS
    assert waited[before][8:, 1].max() <= 0  # the frames of both are there before the instant's end
    assert waited[missing, 1].min() >= LATENESS
    assert waited[missing, 1].max() <= LATENESS + TICK
    assert waited[gone, 1].max() <= 0


@pytest.mark.parametrize("factor", [0.5, 2])
def test_a_change_of_rate_is_followed(factor):
    before, period = row("a", 30) + row("b", 30, 0.1), round(PERIOD * factor)
    shift = 30 * PERIOD
    after = [
        (ns + shift, frame(f.camera, f.t_ns - START + shift))
        for ns, f in row("a", 40, 0.0, 0, period) + row("b", 40, 0.1, 0, period)
    ]
    instants = FrameSynchronizer()
    closed = play(instants, before + after)
    assert used(closed) == sent(before + after)
    assert np.abs(steps(closed)[:20] - PERIOD).max() <= 1
    assert np.abs(steps(closed)[-20:] - period).max() <= 1
    assert sum(instants.late.values()) == 0


def test_after_a_long_silence_there_is_a_new_row():
    """Between the rows only as many empty instants as it takes to know that robots are lost."""
    pause = 3600 * 10**9
    first, second = row("a", 20), row("a", 20, phase=0.3 + pause // PERIOD)
    instants = FrameSynchronizer(PERIOD)
    for now, f in first:
        instants.add(f)
        instants.take(now)
    quiet = instants.take(first[-1][0] + pause)
    assert 0 < len(quiet) <= SILENT_NS // PERIOD + 3
    renewed = play(instants, second)
    assert used(renewed) == sent(second)
    assert all(abs(f.t_ns - i.t_ns) <= PERIOD for _, i in renewed for f in i.frames)
    assert (steps(renewed) == PERIOD).all()


@pytest.mark.parametrize("silence_s", [0.6, 1.0, 1.4, 1.9, 2.5, 10.0])
def test_cameras_that_start_with_one_frame_and_a_silence_lose_none(silence_s: float):
    """Their first step is no rhythm: instants that it would foretell must not close before their frames come."""
    first = [arrival for k in range(4) for arrival in row(f"cam{k}", 1, 0.2 * k)]
    then = [a for k in range(4) for a in row(f"cam{k}", 60, 0.2 * k + silence_s * 1e9 / PERIOD, 5 * MS)]
    instants = FrameSynchronizer(None, LATENESS)
    closed = play(instants, first + then)
    assert used(closed) == sent(first + then)
    assert set(instants.late.values()) == {0}
