# SPDX-License-Identifier: BSD-3-Clause
"""The offset of two clocks: the true offset lies within the error bound for any network delays."""

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from camera_node.clocks.clock_offset import WANDER, WINDOW_NS, OffsetEstimator, RoundTrip

START = 1_700_000_000_000_000_000
MS = 1_000_000
SECOND = 1000 * MS
BURST = 3
SEEDED = [(0, -50e-6), (1, 0.0), (2, 50e-6)]

delays = st.lists(
    st.tuples(st.integers(0, 300 * MS), st.integers(0, 300 * MS), st.integers(MS, 20_000 * MS)),
    min_size=1,
    max_size=60,
)
fewer = settings(max_examples=50)  # lists of sixty
offsets = st.integers(-(10**15), 10**15)
drifts = st.floats(-50e-6, 50e-6)


class World:
    """A server's clock, `offset` ns ahead of this machine's at the start and with a relative drift of `drift`."""

    def __init__(self, offset: int = 0, drift: float = 0.0) -> None:
        self.offset, self.drift, self.now = offset, drift, START
        self.estimator = OffsetEstimator()

    def true_offset(self, t_ns: int) -> float:
        return self.offset + self.drift * (t_ns - START)

    def ask(self, there: int, back: int) -> RoundTrip:
        """A request that takes `there` ns to the server, and its reply that takes `back` ns."""
        sent, arrived = self.now, self.now + there
        self.now = arrived + back
        return RoundTrip(sent, arrived + round(self.true_offset(arrived)), self.now)

    def error(self, t_ns: int) -> tuple[float, float]:
        """The error of the estimate, and its error bound."""
        estimate, bound = self.estimator.at(t_ns) or (0, -1)
        return estimate - self.true_offset(t_ns), bound

    def run(self, seconds: int, delay: Callable[[], tuple[int, int]]) -> np.ndarray:
        """Errors and bounds (n, 2), ns, 20 per second, with a burst of round trips every second."""
        seen = []
        for _ in range(seconds):
            self.estimator.add(*(self.ask(*delay()) for _ in range(BURST)))
            seen += [self.error(self.now + k * SECOND // 20) for k in range(20)]
            self.now += SECOND
        return np.array(seen)


@fewer
@given(offsets, drifts, delays)
def test_the_truth_lies_within_the_bound(offset: int, drift: float, delays: list[tuple[int, int, int]]):
    """With any, also asymmetric delays and 50 ppm of drift, at every round trip and between them."""
    world = World(offset, drift)
    for there, back, pause in delays:
        world.estimator.add(world.ask(there, back))
        for now in (world.now - pause, world.now, world.now + pause // 2, world.now + pause):
            error, bound = world.error(now)
            assert abs(error) <= bound
        world.now += pause


@fewer
@given(offsets, drifts, delays)
def test_no_round_trip_enlarges_the_bound(offset: int, drift: float, delays: list[tuple[int, int, int]]):
    """Within the window, a slow round trip leaves the bound unchanged and a quick one reduces it.

    To a microsecond, for rounding and the uncertainty of the rate.
    """
    world = World(offset, drift)
    for there, back, pause in delays:
        if world.now + there + back - START > WINDOW_NS:
            break
        trip = world.ask(there, back)
        before = world.estimator.at(world.now)
        world.estimator.add(trip)
        after = world.estimator.at(world.now)
        assert after is not None
        assert before is None or after[1] <= before[1] + 1000
        world.now += pause


@fewer
@given(delays, st.lists(st.integers(-100 * MS, 100 * MS), min_size=60, max_size=60))
def test_the_newest_round_trip_bounds_the_error(delays: list[tuple[int, int, int]], jumps: list[int]):
    """For any steps of the clocks, the error is smaller than the duration of the newest round trip."""
    world = World()
    for (there, back, pause), jump in zip(delays, jumps, strict=False):
        world.offset += jump
        world.estimator.add(world.ask(there, back))
        error, _ = world.error(world.now)
        assert abs(error) <= there + back + 2000  # resolution of the clock readings
        world.now += pause


@pytest.mark.parametrize(("seed", "drift"), SEEDED)
def test_a_minute_of_slow_requests_has_little_effect(seed: int, drift: float):
    """Two minutes with delays of 0.1 to 0.3 ms both ways, then one minute in which requests take 10 ms and more.

    Half of the band's width bounds the error. The quick replies determine its lower edge. Its upper edge follows from
    the last quick request, a minute old, and from the largest rate, whose uncertainty is the sum of both delays over
    the two quiet minutes, plus `WANDER`. The quickest request of the last minute alone would give a bound of 5 ms.
    """
    rng, world, quick = np.random.default_rng(seed), World(5 * MS, drift), 0.3e6

    def calm() -> tuple[int, int]:
        return int(rng.uniform(0.1e6, quick)), int(rng.uniform(0.1e6, quick))

    def queued() -> tuple[int, int]:
        return int(10 * MS + rng.exponential(20 * MS)), int(rng.uniform(0.1e6, quick))

    world.run(120, calm)
    seen = world.run(60, queued)
    assert (np.abs(seen[:, 0]) <= seen[:, 1]).all()
    passed_ns = world.now - START - 120 * SECOND
    assert np.abs(seen[:, 0]).max() <= quick + (2 * quick / (119 * SECOND) + WANDER) * passed_ns / 2


@pytest.mark.parametrize(("seed", "drift"), SEEDED)
def test_random_delays_average_out(seed: int, drift: float):
    """Delays both ways are 0.15 ms plus an exponential delay with a mean of 5 ms.

    The mean of the smallest of the 3 n delays in n seconds is 5 ms / 3 n, and after n seconds its bound has grown by
    WANDER n; the sum is smallest, 0.18 ms, where both are equal. This is the error of each edge, and in the worst case
    of the middle; the RMS error of a single round trip is 3.5 ms.
    """
    rng, world = np.random.default_rng(seed), World(-7 * MS, drift)
    mean = 5e6

    def queued() -> tuple[int, int]:
        return int(0.15e6 + rng.exponential(mean)), int(0.15e6 + rng.exponential(mean))

    world.run(20, queued)
    seen = world.run(120, queued)
    assert (np.abs(seen[:, 0]) <= seen[:, 1]).all()
    assert np.sqrt(np.mean(seen[:, 0] ** 2)) < 2 * np.sqrt(mean * WANDER * 1e9 / BURST)


def test_the_estimate_follows_a_clock_that_is_set():
    """A round trip that contradicts the earlier ones shows that a clock was set; the earlier ones are discarded."""
    world = World()
    world.run(5, lambda: (MS, MS))
    for jump in (3_600_000 * MS, -10 * MS):
        world.offset += jump
        world.estimator.add(world.ask(MS, MS))
        error, bound = world.error(world.now)
        assert abs(error) <= bound <= 1.1 * MS


def test_the_estimate_follows_a_clock_that_is_slewed():
    """A time service reverses a drift of 50 ppm: the error stays below a round trip and within the bound afterwards."""
    world = World()
    world.run(120, lambda: (MS // 4, MS // 4))
    world.offset, world.drift = round(-50e-6 * (world.now - START)), 50e-6
    seen = world.run(60, lambda: (MS // 4, MS // 4))
    assert np.abs(seen[:, 0]).max() <= MS // 2 + 50e-6 * SECOND
    error, bound = world.error(world.now)
    assert abs(error) <= bound + 50e-6 * SECOND


def test_round_trips_older_than_the_window_have_no_effect():
    """Quick ones at the beginning, which would reduce the bound if they were still used."""
    world, recent = World(), OffsetEstimator()
    trips = []
    for k in range(40):
        delay = MS // 1000 if k < 5 else 20 * MS
        trips.append(world.ask(delay, delay))
        world.now += 10 * SECOND
    for trip in trips:
        world.estimator.add(trip)
        if trips[-1].received_ns - trip.sent_ns <= WINDOW_NS:
            recent.add(trip)
    assert world.estimator.at(world.now) == recent.at(world.now)


def test_there_is_no_estimate_before_the_first_round_trip():
    assert OffsetEstimator().at(START) is None
