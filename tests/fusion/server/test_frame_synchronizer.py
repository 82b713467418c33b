# SPDX-License-Identifier: BSD-3-Clause
"""Properties of the frame synchronizer. The tests set the time."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from camera_node.detection.roundels import Roundels
from fusion.model.frames import CalibratedFrame, FrameSet
from fusion.model.limits import Limits
from fusion.model.undistortion import N_ROWS
from fusion.server.frame_synchronizer import SILENT_NS, FrameSynchronizer

pytestmark = pytest.mark.computed
PERIOD = 33_333_333
MS = 1_000_000
TICK = 5 * MS
START = 10**12
NOTHING = Roundels.from_points(np.empty((0, 2)), 0.3)
LATENESS = round(Limits().lateness_ms * MS)
Arrivals = list[tuple[int, CalibratedFrame]]


def frame(camera: str, t_ns: int, delay: int = 0) -> CalibratedFrame:
    received_ns = START + t_ns + delay
    return CalibratedFrame(camera, START + t_ns, NOTHING, np.empty((N_ROWS, 0)), received_ns=received_ns)


def frames_of(camera: str, n: int, phase: float = 0.0, delay: int = 0, period: int = PERIOD) -> Arrivals:
    """`n` frames of a camera and their times of arrival."""
    return [
        (START + delay + round(t), frame(camera, round(t), delay)) for t in (np.arange(n) + phase) * period
    ]


def play(synchronizer: FrameSynchronizer, arrivals: Arrivals) -> list[tuple[int, FrameSet]]:
    """The frame sets and when each closed, asked at every arrival and tick; 0 for the last ones, of `finish`.

    No set closes before it begins: the frames of its cameras would be too late.
    """
    arrivals = sorted(arrivals, key=lambda arrival: arrival[0])
    closed, now = [], arrivals[0][0]
    for arrival_ns, frame in arrivals:
        while now < arrival_ns:
            now = min(now + TICK, arrival_ns)
            closed += [(now, frame_set) for frame_set in synchronizer.take(now)]
        synchronizer.add(frame)
        closed += [(now, frame_set) for frame_set in synchronizer.take(now)]
    assert all(now >= frame_set.t_ns - (synchronizer.period_ns or 0) for now, frame_set in closed)
    return closed + [(0, frame_set) for frame_set in synchronizer.finish()]


def withhold_after(synchronizer: FrameSynchronizer, arrivals: Arrivals) -> int:
    """Fuse these frames, then wait for their cameras no longer; the time of the last arrival."""
    arrivals = sorted(arrivals, key=lambda arrival: arrival[0])
    for at_ns, f in arrivals:
        synchronizer.add(f)
        synchronizer.take(at_ns)
    for name in {f.camera for _, f in arrivals}:
        synchronizer.ignore(name)
    return arrivals[-1][0]


def used(closed: list[tuple[int, FrameSet]]) -> list[tuple[str, int]]:
    return sorted((f.camera, f.t_ns) for _, frame_set in closed for f in frame_set.frames)


def sent(arrivals: Arrivals) -> list[tuple[str, int]]:
    return sorted((f.camera, f.t_ns) for _, f in arrivals)


def steps(closed: list[tuple[int, FrameSet]]) -> np.ndarray:
    return np.diff([frame_set.t_ns for _, frame_set in closed])


@settings(max_examples=50)
@given(
    phases=st.lists(st.floats(-0.5, 0.5), min_size=1, max_size=5),
    period=st.integers(10 * MS, 100 * MS),
)
def test_every_frame_is_in_the_nearest_frame_set_and_in_no_other(phases, period):
    """A frame set does not wait for a frame that may belong to the next one: to a tenth of a period."""
    arrivals = [a for k, p in enumerate(phases) for a in frames_of(f"cam{k}", 20, p, period=period)]
    synchronizer = FrameSynchronizer(period)
    closed = play(synchronizer, arrivals)
    assert used(closed) == sent(arrivals)
    off = [abs(f.t_ns - frame_set.t_ns) for _, frame_set in closed for f in frame_set.frames]
    assert max(off) <= 0.6 * period + 2
    assert (steps(closed) == period).all()
    assert sum(synchronizer.late.values()) == 0


@settings(max_examples=50)
@given(
    phases=st.lists(st.floats(-0.5, 0.5), min_size=2, max_size=4),
    delays=st.lists(st.integers(0, 140), min_size=4),
)
def test_frames_within_the_wait_limit_are_used_once(phases, delays):
    arrivals = [a for k, p in enumerate(phases) for a in frames_of(f"cam{k}", 30, p, delays[k] * MS)]
    synchronizer = FrameSynchronizer(PERIOD, LATENESS)
    assert used(play(synchronizer, arrivals)) == sent(arrivals)
    assert sum(synchronizer.late.values()) == 0


@pytest.mark.parametrize("lag_ms", [100, 400])
def test_cameras_that_all_lag_are_fused_without_loss(lag_ms):
    """USB cameras may lag by 0.1 s, network streams by 0.4 s, which is more than the wait limit: every frame set has a
    frame of each, and closes as soon as all have arrived."""
    arrivals = [a for k, p in enumerate((0.0, 0.2, -0.3)) for a in frames_of(f"cam{k}", 40, p, lag_ms * MS)]
    synchronizer = FrameSynchronizer(lateness_ns=LATENESS)
    closed = play(synchronizer, arrivals)
    assert used(closed) == sent(arrivals)
    assert {len(frame_set.frames) for _, frame_set in closed[1:-1]} == {3}
    assert max(now - frame_set.t_ns for now, frame_set in closed[10:]) < lag_ms * MS + PERIOD


def test_cameras_that_begin_to_lag_lose_few_frames():
    """A network becomes slow: after half a second, frame sets wait for its frames."""
    lags = [20 * MS] * 60 + [300 * MS] * 60
    arrivals = [
        (at_ns + lag, frame(name, f.t_ns - START, lag))
        for k, name in enumerate("abc")
        for (at_ns, f), lag in zip(frames_of(name, 120, 0.25 * k), lags, strict=True)
    ]
    synchronizer = FrameSynchronizer(lateness_ns=LATENESS)
    closed = play(synchronizer, arrivals)
    assert sum(synchronizer.late.values()) <= 3 * 15
    assert {len(frame_set.frames) for _, frame_set in closed[-21:-1]} == {3}


def test_frames_that_missed_their_set_are_used_in_the_next_one_at_their_own_time():
    """A camera is slower than the wait limit by half an interval."""
    arrivals = frames_of("a", 40) + frames_of("b", 40, 0.1, LATENESS + PERIOD // 2)
    synchronizer = FrameSynchronizer(PERIOD, LATENESS)
    closed = play(synchronizer, arrivals)
    assert used(closed) == sent(arrivals)
    taus = [f.t_ns - frame_set.t_ns for _, frame_set in closed for f in frame_set.frames if f.camera == "b"]
    assert -1.5 * PERIOD < min(taus) < -PERIOD / 2
    assert synchronizer.late == {"a": 0, "b": 0}


def test_frames_that_missed_two_sets_are_dropped_and_counted():
    """Robots have accelerated since: by such frames, a camera that was 0.3 s late looked turned."""
    arrivals = frames_of("a", 40) + frames_of("b", 40, 0.1, 2 * LATENESS)
    synchronizer = FrameSynchronizer(PERIOD, LATENESS)
    closed = play(synchronizer, arrivals)
    taus = [f.t_ns - frame_set.t_ns for _, frame_set in closed for f in frame_set.frames]
    assert min(taus) > -1.5 * PERIOD
    late = synchronizer.late["b"]
    assert late > 10
    assert len(used(closed)) == len(sent(arrivals)) - late


def test_a_frame_that_comes_after_later_ones_is_dropped_and_counted():
    arrivals = frames_of("a", 40) + frames_of("b", 40, 0.1)
    late_ns, late = arrivals[60]
    arrivals[60] = (late_ns + 2 * PERIOD, late)
    synchronizer = FrameSynchronizer(PERIOD, LATENESS)
    closed = play(synchronizer, arrivals)
    assert not any(f is late for _, frame_set in closed for f in frame_set.frames)
    assert synchronizer.late == {"a": 0, "b": 1}


def test_a_silent_camera_delays_frame_sets_up_to_the_limit_until_it_is_gone():
    arrivals = frames_of("a", 90) + frames_of("b", 30, 0.1)
    silent_ns = arrivals[-1][1].t_ns
    closed = play(FrameSynchronizer(PERIOD, LATENESS), arrivals)[:-1]
    waited = np.array(
        [(frame_set.t_ns - silent_ns, now - frame_set.t_ns - PERIOD // 2) for now, frame_set in closed]
    )
    before = waited[:, 0] < 0
    missing = (waited[:, 0] > PERIOD) & (waited[:, 0] < SILENT_NS - LATENESS - PERIOD)
    gone = waited[:, 0] > SILENT_NS
    assert waited[before][8:, 1].max() <= 0  # the frames of both arrive before the end of the set
    assert waited[missing, 1].min() >= LATENESS
    assert waited[missing, 1].max() <= LATENESS + TICK
    assert waited[gone, 1].max() <= 0


@pytest.mark.parametrize("factor", [0.5, 2])
def test_the_period_adapts_to_a_change_of_rate(factor):
    before, period = frames_of("a", 30) + frames_of("b", 30, 0.1), round(PERIOD * factor)
    shift = 30 * PERIOD
    after = [
        (ns + shift, frame(f.camera, f.t_ns - START + shift))
        for ns, f in frames_of("a", 40, 0.0, 0, period) + frames_of("b", 40, 0.1, 0, period)
    ]
    synchronizer = FrameSynchronizer()
    closed = play(synchronizer, before + after)
    assert used(closed) == sent(before + after)
    assert np.abs(steps(closed)[:20] - PERIOD).max() <= 1
    assert np.abs(steps(closed)[-20:] - period).max() <= 1
    assert sum(synchronizer.late.values()) == 0


def test_no_frame_set_holds_all_frames_of_cameras_that_became_faster():
    """Cameras whose frames were lost for a while seem slow. Once they are faster, a set ends as soon as that is known:
    by the median of the last eight intervals, so four of them are enough. Only those are lost that belong to the slow
    set that their first frame completed."""
    slow, shift = frames_of("a", 10, period=1000 * MS), 10_000 * MS
    fast = [(ns + shift, frame(f.camera, f.t_ns - START + shift)) for ns, f in frames_of("a", 60)]
    synchronizer = FrameSynchronizer()
    closed = play(synchronizer, slow + fast)
    assert max(len(frame_set.frames) for _, frame_set in closed) <= 6
    assert (steps(closed) > 0).all()
    lost = sorted(set(sent(slow + fast)) - set(used(closed)))
    assert len(lost) == sum(synchronizer.late.values())
    assert all(START + shift < t_ns < START + shift + 500 * MS for _, t_ns in lost)


def test_a_new_sequence_starts_after_a_long_silence():
    """Between both sequences there are only as many empty sets as make robots lost."""
    pause = 3600 * 10**9
    first, second = frames_of("a", 20), frames_of("a", 20, phase=0.3 + pause // PERIOD)
    synchronizer = FrameSynchronizer(PERIOD)
    for now, f in first:
        synchronizer.add(f)
        synchronizer.take(now)
    quiet = synchronizer.take(first[-1][0] + pause)
    assert 0 < len(quiet) <= SILENT_NS // PERIOD + 3
    renewed = play(synchronizer, second)
    assert used(renewed) == sent(second)
    assert all(abs(f.t_ns - i.t_ns) <= PERIOD for _, i in renewed for f in i.frames)
    assert (steps(renewed) == PERIOD).all()


@pytest.mark.parametrize("silence_s", [0.6, 1.0, 1.4, 1.9, 2.5, 10.0])
def test_cameras_that_pause_after_their_first_frame_lose_none(silence_s: float):
    """Their first interval is not their rate: frame sets predicted from it must not close before their frames come."""
    first = [arrival for k in range(4) for arrival in frames_of(f"cam{k}", 1, 0.2 * k)]
    then = [a for k in range(4) for a in frames_of(f"cam{k}", 60, 0.2 * k + silence_s * 1e9 / PERIOD, 5 * MS)]
    synchronizer = FrameSynchronizer(None, LATENESS)
    closed = play(synchronizer, first + then)
    assert used(closed) == sent(first + then)
    assert set(synchronizer.late.values()) == {0}


@pytest.mark.parametrize("pause_s", [0.2, 0.6, 1.4, 1.9])
def test_cameras_that_pause_after_they_were_withheld_lose_none(pause_s: float):
    """The pause is the only interval that is known of them, and is not their rate either."""
    synchronizer, cameras = FrameSynchronizer(PERIOD, LATENESS), {"a": 0.0, "b": 0.3}
    before = [arrival for name, phase in cameras.items() for arrival in frames_of(name, 20, phase)]
    withhold_after(synchronizer, before)
    first = [arrival for name, phase in cameras.items() for arrival in frames_of(name, 1, phase + 21)]
    shift = 21 + pause_s * 1e9 / PERIOD
    then = [a for name, phase in cameras.items() for a in frames_of(name, 60, phase + shift, 5 * MS)]
    closed = play(synchronizer, first + then)
    assert set(sent(first + then)) <= set(used(closed))
    assert set(synchronizer.late.values()) == {0}


@pytest.mark.parametrize("silence_ms", [40, 100, 400, 3000])
def test_no_frame_set_lies_in_the_future_while_no_camera_is_waited_for(silence_ms: int):
    """All cameras are withheld for a while: the wait limit closes empty sets, and the next frames are on time."""
    synchronizer = FrameSynchronizer(PERIOD)
    last_ns = withhold_after(synchronizer, frames_of("a", 20) + frames_of("b", 20, 0.3))
    back_ns = last_ns + silence_ms * MS
    closed = [(now, s) for now in range(last_ns, back_ns, TICK) for s in synchronizer.take(now)]
    assert all(now - frame_set.t_ns >= LATENESS for now, frame_set in closed)
    assert closed or silence_ms * MS < LATENESS
    assert synchronizer.add(frame("a", back_ns - START))
    renewed = synchronizer.take(back_ns + LATENESS + PERIOD)
    assert back_ns in [f.t_ns for frame_set in renewed for f in frame_set.frames]
