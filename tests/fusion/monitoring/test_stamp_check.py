# SPDX-License-Identifier: BSD-3-Clause
"""Jumps of stamps: found in their first frame, with the right size; frames that are late, lost or swapped are none."""

from collections.abc import Iterable

import numpy as np
import pytest

from fusion.monitoring.stamp_check import HISTORY, LEARNED, StampCheck, StampJump

PERIOD_NS, LAG_NS = 33_333_333, 12_000_000
N_RUNS = 20
SINCE = 60  # frames after the event
# Lags of 50 ms show a jump in one frame of many, if at all: a wrong decision needs a lag below all of 64 earlier ones.
MAX_WRONG = 2


def jumps(captured: Iterable[int], stamps: Iterable[int], jitter_ms: float, seed: int) -> list[StampJump]:
    """Those of frames in order of arrival; the varying part of the lag has an exponential distribution."""
    rng, check = np.random.default_rng(seed), StampCheck()
    frames = [
        (at + LAG_NS + round(rng.exponential(jitter_ms * 1e6)), stamp)
        for at, stamp in zip(captured, stamps, strict=True)
    ]
    found = (check.add(stamp, received_ns) for received_ns, stamp in sorted(frames))
    return [jump for jump in found if jump is not None]


def regular(n: int = HISTORY + SINCE) -> list[int]:
    return [k * PERIOD_NS for k in range(n)]


def stepped(step_ms: float) -> list[int]:
    return [t + round(step_ms * 1e6) * (k >= HISTORY) for k, t in enumerate(regular())]


@pytest.mark.parametrize("step_ms", [25.0, -25.0, 400.0, -400.0, 500.0, -1000.0, 1e3 / 15])
def test_a_jump_is_found_with_its_size(step_ms: float):
    """Also by a multiple of the interval, where only the lag shows it."""
    for seed in range(N_RUNS):
        (jump,) = jumps(regular(), stepped(step_ms), 1.0, seed)
        assert jump.ahead_ns == pytest.approx(step_ms * 1e6, abs=10)
        assert jump.sigma_ns < 100


@pytest.mark.parametrize("step_ms", [25.0, -25.0])
def test_a_jump_below_the_jitter_is_known_or_in_doubt(step_ms: float):
    """The clock's standard deviation covers it from the first frame on."""
    found = [jumps(regular(), stepped(step_ms), 50.0, seed) for seed in range(N_RUNS)]
    covered = [
        run != [] and abs(step_ms * 1e6 - run[0].ahead_ns) <= max(run[0].sigma_ns, 1.0) for run in found
    ]
    assert sum(covered) >= N_RUNS - MAX_WRONG


def test_frames_that_are_missing_while_stamps_jump_back_make_the_jump_uncertain():
    """A node that is started again: the interval alone shows 300 ms less. The standard deviation covers the truth."""
    captured = [t + 300_000_000 * (k >= HISTORY) for k, t in enumerate(regular())]
    stamps = [t - 10**9 * (k >= HISTORY) for k, t in enumerate(captured)]
    for seed in range(N_RUNS):
        (jump,) = jumps(captured, stamps, 1.0, seed)
        assert abs(-1e9 - jump.ahead_ns) <= jump.sigma_ns < 0.4e9


@pytest.mark.parametrize("jitter_ms", [1.0, 50.0])
def test_a_pause_of_the_camera_is_no_jump(jitter_ms: float):
    """Where lags vary less than the pause they rule a jump out; else the clock is in doubt by less than the pause."""
    captured = [t + 25_000_000 * (k >= HISTORY) for k, t in enumerate(regular())]
    runs = [jumps(captured, captured, jitter_ms, seed) for seed in range(N_RUNS)]
    assert sum(any(jump.ahead_ns for jump in run) for run in runs) <= MAX_WRONG
    assert max(len(run) for run in runs) <= (1 if jitter_ms > 25 else 0)
    assert all(jump.sigma_ns <= PERIOD_NS for run in runs for jump in run)


@pytest.mark.parametrize("jitter_ms", [1.0, 10.0])
def test_missing_and_swapped_frames_are_no_jump(jitter_ms: float):
    found = []
    for seed in range(N_RUNS):
        present = np.random.default_rng(seed).random(HISTORY + SINCE) > 0.3
        captured = [t for t, is_present in zip(regular(), present, strict=True) if is_present]
        found += jumps(captured, captured, jitter_ms, seed)
    assert found == []


@pytest.mark.parametrize("jitter_ms", [1.0, 10.0])
def test_another_rate_of_the_camera_is_no_jump(jitter_ms: float):
    """Of an exposure that is set longer or shorter, and of one that varies all the time."""
    n = np.arange(HISTORY + SINCE)
    for factor in (
        1.3 * (n >= HISTORY) + (n < HISTORY),
        0.5 * (n >= HISTORY) + (n < HISTORY),
        1 + 0.5 * np.sin(n),
    ):
        captured = np.cumsum(PERIOD_NS * factor).astype(int).tolist()
        runs = [jumps(captured, captured, jitter_ms, seed) for seed in range(N_RUNS)]
        assert not any(jump.ahead_ns for run in runs for jump in run)


def test_a_late_frame_is_no_jump():
    """A slow network leaves the intervals between the stamps as they are."""
    check = StampCheck()
    lags_ms = [10 + k % 3 for k in range(HISTORY)] + [50, 30, 11]
    assert not any(
        check.add(t, t + round(1e6 * lag)) for t, lag in zip(regular(len(lags_ms)), lags_ms, strict=True)
    )


def test_a_frame_that_many_others_overtake_is_no_jump():
    """It fills a gap between their stamps."""
    for seed in range(N_RUNS):
        rng, check = np.random.default_rng(seed), StampCheck()
        lags_ms = 12 + rng.exponential(20, HISTORY + SINCE) + 500 * (np.arange(HISTORY + SINCE) == HISTORY)
        frames = [(t + round(1e6 * lag), t) for t, lag in zip(regular(), lags_ms, strict=True)]
        assert not any(check.add(t, received_ns) for received_ns, t in sorted(frames))


@pytest.mark.parametrize("taken", [0.8, 0.4], ids=["some frames are skipped", "most frames are skipped"])
def test_the_end_of_a_load_is_no_jump(taken: float):
    """A busy machine takes some frames and sends them late; when the load ends, frames arrive sooner than any before,
    after a frame that was skipped. They arrive after they were taken."""
    for seed in range(N_RUNS):
        rng, check = np.random.default_rng(seed), StampCheck()
        stamps = [t for t in regular() if rng.random() < taken]
        lags_ms = rng.uniform(60, 160, len(stamps)) * (np.arange(len(stamps)) < HISTORY // 2) + LAG_NS / 1e6
        found = [check.add(t, t + round(1e6 * lag)) for t, lag in zip(stamps, lags_ms, strict=True)]
        assert not any(found)


def sigmas_ms(stamps: Iterable[float]) -> np.ndarray:
    """Standard deviations of single stamps, once there are enough of them."""
    check, found = StampCheck(), []
    for stamp in stamps:
        check.add(round(stamp), round(stamp) + LAG_NS)
        found.append(check.sigma_ns / 1e6)
    return np.array(found[LEARNED:])


@pytest.mark.parametrize("sigma_ms", [1.0, 3.0])
def test_errors_of_single_stamps_show_in_their_intervals(sigma_ms: float):
    """Of 16 stamps, of which a line takes two freedoms, to 19 %; their mean over 60 independent ones to 3 %."""
    errors = 1e6 * sigma_ms * np.random.default_rng(2).normal(size=1000)
    found = sigmas_ms(np.arange(1000) * PERIOD_NS + errors)
    assert np.sqrt(np.mean(found**2)) == pytest.approx(sigma_ms, rel=0.1)
    assert np.percentile(found, 99) < 2 * sigma_ms


@pytest.mark.parametrize("taken", [1.0, 0.8, 0.3, 0.1])
def test_stamps_of_a_constant_rate_are_exact_also_if_frames_are_missing(taken: float):
    rng = np.random.default_rng(3)
    errors = 20_000 * rng.normal(size=1000)
    assert sigmas_ms((np.arange(1000) * PERIOD_NS + errors)[rng.random(1000) < taken]).max() < 0.05
