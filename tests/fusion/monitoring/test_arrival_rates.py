# SPDX-License-Identifier: BSD-3-Clause
"""The rates of clocks by arrivals are within their claims; delays that grow, and queues that end, show none."""

import math
from collections.abc import Callable

import numpy as np
import pytest

from camera_node.detection.roundels import Roundels
from fusion.model.frames import CalibratedFrame
from fusion.monitoring.arrival_rates import ArrivalRate, ArrivalRates

START_NS, HZ, TRANSIT_S = 10**18, 30.0, 2e-3
NOTHING = Roundels.from_points(np.empty((0, 2)), 0.3)


def measured(
    seconds: float,
    seed: int = 0,
    stamped: Callable[[float], float] = lambda t: t,
    delay_s: Callable[[float], float] = lambda t: 0.0,
    has_arrivals: bool = True,
) -> list[tuple[float, ArrivalRate]]:
    """When a rate is shown, and the rate, of frames at times t that are stamped so and delayed by that, beside a
    transit of random duration."""
    rng, rates, found = np.random.default_rng(seed), ArrivalRates(), []
    for t in np.arange(0.0, seconds, 1 / HZ):
        arrived = t + 5e-3 + delay_s(t) + rng.exponential(TRANSIT_S)
        stamp_ns = START_NS + round(1e9 * stamped(t))
        sent_ns = stamp_ns if has_arrivals else 0
        frame = CalibratedFrame(
            *("cam0", stamp_ns, NOTHING, np.zeros((19, 0)), stamp_ns, sent_ns),
            received_ns=START_NS + round(1e9 * arrived),
        )
        if (shown := rates.add(frame)) is not None:
            found.append((t, shown))
    return found


@pytest.mark.parametrize("ppm", [0.0, 50.0, 500.0, 2000.0])
def test_a_clock_that_runs_fast_is_measured_within_its_claim(ppm: float):
    """Offsets fall: true times are less and less later than stamps."""
    deviations = []
    for seed in range(10):
        found = measured(30.0, seed, lambda t: t * (1 + ppm * 1e-6))
        assert len(found) > 15
        deviations += [(shown.rate + ppm * 1e-6) / shown.sigma for _, shown in found]
        assert np.median([shown.sigma for _, shown in found]) < 5e-4
    assert np.mean(np.square(deviations)) < 1.0


def test_stamps_that_tick_show_less():
    found = measured(60.0, 1, lambda t: 0.016 * math.floor(t / 0.016))
    assert found
    assert np.mean([(shown.rate / shown.sigma) ** 2 for _, shown in found if shown.sigma < math.inf]) < 1.0


@pytest.mark.parametrize("per_s", [5e-4, 2e-3, 8e-3])
def test_delays_that_grow_are_admitted_and_not_measured(per_s: float):
    """As by congestion. The clock may be as slow as that."""
    found = [
        shown for t, shown in measured(30.0, 2, delay_s=lambda t: per_s * max(0.0, t - 15.0)) if t > 17.0
    ]
    assert sum(shown.sigma < math.inf for shown in found) <= 1
    assert any(shown.sigma == math.inf and shown.rate > per_s / 3 for shown in found)


@pytest.mark.parametrize("per_s", [2e-3, 8e-3])
def test_a_queue_that_empties_shows_no_fast_clock(per_s: float):
    def queue_s(t: float) -> float:
        return max(0.0, per_s * (t - 10.0) if t < 20.0 else per_s * (30.0 - t))

    found = [shown for t, shown in measured(45.0, 3, delay_s=queue_s) if t > 12.0 and shown.sigma < math.inf]
    assert found  # once it is empty
    assert max(abs(shown.rate) / shown.sigma for shown in found) < 5.0


def test_a_load_that_ends_shows_no_fast_clock():
    """Frames arrive 20 ms sooner from then on than any before."""
    found = measured(45.0, 4, delay_s=lambda t: 0.02 if t < 20.0 else 0.0)
    assert max(abs(shown.rate) / shown.sigma for _, shown in found if shown.sigma < math.inf) < 5.0
    assert max(t for t, _ in found) > 40.0


def test_without_arrivals_no_rate_is_measured():
    assert measured(20.0, 5, lambda t: 1.001 * t, has_arrivals=False) == []
