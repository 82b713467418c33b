# SPDX-License-Identifier: BSD-3-Clause
"""One irregular interval between stamps is a jump or a pause of the camera; where one arrival can't tell, more do."""

from collections.abc import Iterable, Iterator

import numpy as np
import pytest

from fusion.monitoring.clocks.arrival_monitor import ArrivalMonitor
from fusion.monitoring.clocks.stamp_check import HISTORY, StampCheck
from fusion.monitoring.clocks.undecided_jump import DECIDED
from tests.benchmarks.fusion_load import Load
from tests.fusion.clock_faults import GRACE_S, fuse, step

PERIOD_NS, LAG_NS = 33_333_333, 12_000_000
N_RUNS = 20
# A decision is wrong once in a thousand lags that are just as rare (`RARE`); of up to 16 in a row, one in a hundred.
MAX_WRONG = 2
Frame = tuple[int, int]  # stamp and arrival, ns


def arriving(
    captured_ns: Iterable[int], stamps_ns: Iterable[int], jitter_ms: float, seed: int
) -> list[Frame]:
    """Frames in order of arrival; the varying part of the lag has an exponential distribution."""
    rng = np.random.default_rng(seed)
    frames = [
        (stamp, at + LAG_NS + round(rng.exponential(jitter_ms * 1e6)))
        for at, stamp in zip(captured_ns, stamps_ns, strict=True)
    ]
    return sorted(frames, key=lambda frame: frame[1])


def regular(n: int, first_ns: int = 0) -> list[int]:
    return [first_ns + k * PERIOD_NS for k in range(n)]


def with_step(step_ms: float, jitter_ms: float, seed: int) -> tuple[list[Frame], int]:
    """Frames of stamps that jump, and the first true time after the jump."""
    n = HISTORY + 3 * DECIDED
    captured = regular(n)
    stamps = [t + round(step_ms * 1e6) * (k >= HISTORY) for k, t in enumerate(captured)]
    return arriving(captured, stamps, jitter_ms, seed), stamps[HISTORY]


def after_pause(pause_ms: float, jitter_ms: float, seed: int) -> list[Frame]:
    """Frames of a camera whose exposures pause once, with right stamps."""
    before = regular(HISTORY)
    captured = before + regular(3 * DECIDED, before[-1] + PERIOD_NS + round(pause_ms * 1e6))
    return arriving(captured, captured, jitter_ms, seed)


def verdicts(frames: list[Frame]) -> Iterator[str]:
    """After each frame: "jumped" from the frame on that shows it, "undecided", or "regular"."""
    check, jumped = StampCheck(), False
    for stamp_ns, received_ns in frames:
        jumped |= check.has_jumped(stamp_ns, received_ns)
        yield "jumped" if jumped else "undecided" if check.is_undecided else "regular"


@pytest.mark.parametrize("jitter_ms", [30.0, 50.0])
@pytest.mark.parametrize("step_ms", [25.0, -25.0, 10.0])
def test_a_step_below_the_jitter_is_in_doubt_at_once_and_then_certain(step_ms: float, jitter_ms: float):
    n_late, n_missed = 0, 0
    for seed in range(N_RUNS):
        frames, first_ns = with_step(step_ms, jitter_ms, seed)
        found = list(verdicts(frames))
        at = next(
            k for k, (stamp_ns, _) in enumerate(frames) if (stamp_ns - first_ns) % PERIOD_NS < 2 * len(frames)
        )
        n_late += found[at] == "regular"
        n_missed += found[-1] != "jumped"
    assert n_late <= MAX_WRONG
    assert n_missed <= MAX_WRONG + (N_RUNS // 10 if abs(step_ms) < jitter_ms / 2 else 0)


@pytest.mark.parametrize("step_ms", [25.0, -25.0])
def test_the_stamps_tell_the_size_of_a_step_that_arrivals_hide(step_ms: float):
    """The median of 16 lags with a mean of 50 ms has a sigma of 13 ms."""
    n_wrong = 0
    for seed in range(N_RUNS):
        check, sizes_ns = StampCheck(), []
        for stamp_ns, received_ns in with_step(step_ms, 50.0, seed)[0]:
            if check.has_jumped(stamp_ns, received_ns):
                sizes_ns.append(check.change_ns())
        n_wrong += sizes_ns != pytest.approx([step_ms * 1e6], abs=1e3)
    assert n_wrong <= 2 * MAX_WRONG


@pytest.mark.parametrize(("jitter_ms", "undecided"), [(1.0, 0), (50.0, 2 * DECIDED)])
def test_a_pause_of_the_camera_is_no_jump(jitter_ms: float, undecided: int):
    """Where lags vary less than the pause, the first one rules the jump out."""
    runs = [list(verdicts(after_pause(25.0, jitter_ms, seed))) for seed in range(N_RUNS)]
    assert sum("jumped" in run for run in runs) <= MAX_WRONG
    assert max(run.count("undecided") for run in runs) <= undecided
    assert sum(run[-1] == "undecided" for run in runs) == 0


@pytest.mark.parametrize("jitter_ms", [1.0, 50.0])
def test_missing_frames_leave_the_intervals_regular(jitter_ms: float):
    """Frames that overtake each other by more than the missing ones are rare."""
    n_undecided = n_jumped = 0
    for seed in range(N_RUNS):
        present = np.random.default_rng(seed).random(2 * HISTORY) > 0.3
        captured = [t for t, is_present in zip(regular(2 * HISTORY), present, strict=True) if is_present]
        run = list(verdicts(arriving(captured, captured, jitter_ms, seed)))
        n_jumped += "jumped" in run
        n_undecided += run.count("undecided")
    assert n_jumped <= MAX_WRONG
    assert n_undecided <= 0.01 * N_RUNS * 2 * HISTORY


@pytest.mark.parametrize("jitter_ms", [1.0, 50.0])
def test_another_rate_of_the_camera_is_no_jump(jitter_ms: float):
    """Of an exposure that is set longer, also gradually: more than one interval is irregular."""
    for seed in range(N_RUNS):
        steps = np.where(np.arange(2 * HISTORY) < HISTORY, PERIOD_NS, 1.3 * PERIOD_NS)
        gradual = PERIOD_NS * (1 + 0.5 * np.sin(np.arange(2 * HISTORY)))
        for intervals in (steps, gradual):
            captured = np.cumsum(intervals).astype(int).tolist()
            run = list(verdicts(arriving(captured, captured, jitter_ms, seed)))
            assert run.count("undecided") <= DECIDED
            assert "jumped" not in run


def test_a_pause_of_all_cameras_excludes_none():
    """Of a common trigger, or of the machine."""
    names, monitor = tuple("abcd"), ArrivalMonitor("abcd")
    frames = sorted(
        (received_ns, stamp_ns, name)
        for k, name in enumerate(names)
        for stamp_ns, received_ns in after_pause(25.0, 50.0, k)
    )
    seen: dict[str, int] = {}
    paused_ns = HISTORY * PERIOD_NS
    for received_ns, stamp_ns, name in frames:
        monitor.observe(name, stamp_ns, received_ns)
        seen[name] = seen.get(name, 0) + (stamp_ns > paused_ns)
        if min(seen.get(other, 0) for other in names) > 0:
            assert not monitor.undecided | monitor.jumped
    assert min(seen.values()) > DECIDED


@pytest.mark.parametrize("step_ms", [25.0, pytest.param(-25.0, marks=pytest.mark.slow)])
def test_no_pose_is_wrong_after_a_step_that_arrivals_hide(step_ms: float):
    """Before: poses were up to 0.4 m wrong for a second, until motion contradicted the stamps."""
    load = Load(robots=3, cameras=4, hz=30.0, speed_m_s=1.0, crossing=True)
    outcome = fuse(load, 4.5, {"cam1": step(2.5, step_ms * 1e-3)}, jitter_s=0.05)
    assert outcome.wrong(2.5 + GRACE_S) == []
    assert outcome.moves == []
    assert 2.5 < outcome.reported_s("cam1") < 3.5
    assert outcome.in_use_since_s("cam1") < 4.5
