# SPDX-License-Identifier: BSD-3-Clause
"""The offset of two clocks: the truth lies within the bound, whatever the network does."""

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from camera_node.node.clock_offset import WANDER, WINDOW_NS, OffsetEstimator, RoundTrip

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
    """A server's clock: `offset` ahead of this machine's at the start, and running `drift` faster."""

    def __init__(self, offset: int = 0, drift: float = 0.0) -> None:
        self.offset, self.drift, self.now = offset, drift, START
        self.estimator = OffsetEstimator()

    def true_offset(self, t_ns: int) -> float:
        return self.offset + self.drift * (t_ns - START)

    def ask(self, there: int, back: int) -> RoundTrip:
        """A question that takes `there` ns to the server and `back` ns from it."""
        sent, met = self.now, self.now + there
        self.now = met + back
        return RoundTrip(sent, met + round(self.true_offset(met)), self.now)

    def off(self, t_ns: int) -> tuple[float, float]:
        """By how much the estimate is off, and what it claims at most."""
        estimate, bound = self.estimator.at(t_ns) or (0, -1)
        return estimate - self.true_offset(t_ns), bound

    def live(self, seconds: int, delay: Callable[[], tuple[int, int]]) -> np.ndarray:
        """Errors and bounds (n, 2), ns, twenty a second, while a burst is made every second."""
        seen = []
        for _ in range(seconds):
            self.estimator.add(*(self.ask(*delay()) for _ in range(BURST)))
            seen += [self.off(self.now + k * SECOND // 20) for k in range(20)]
            self.now += SECOND
        return np.array(seen)


@fewer
@given(offsets, drifts, delays)
def test_the_truth_lies_within_the_bound(offset: int, drift: float, delays: list[tuple[int, int, int]]):
    """With any delays, however asymmetric, and 50 ppm of drift, at every round trip and between them."""
    world = World(offset, drift)
    for there, back, pause in delays:
        world.estimator.add(world.ask(there, back))
        for now in (world.now - pause, world.now, world.now + pause // 2, world.now + pause):
            error, bound = world.off(now)
            assert abs(error) <= bound
        world.now += pause


@fewer
@given(offsets, drifts, delays)
def test_no_round_trip_makes_it_worse(offset: int, drift: float, delays: list[tuple[int, int, int]]):
    """What is known stays known while it is remembered: a slow round trip leaves the bound, a quick one lessens it.

    To a microsecond, as rounding and what rates leave open may tip either way.
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
def test_the_newest_round_trip_is_never_contradicted(delays: list[tuple[int, int, int]], jumps: list[int]):
    """Whatever clocks do, the estimate is off by less than the newest round trip took."""
    world = World()
    for (there, back, pause), jump in zip(delays, jumps, strict=False):
        world.offset += jump
        world.estimator.add(world.ask(there, back))
        error, _ = world.off(world.now)
        assert abs(error) <= there + back + 2000  # how finely clocks are read
        world.now += pause


@pytest.mark.parametrize(("seed", "drift"), SEEDED)
def test_a_bad_minute_of_one_way_moves_little(seed: int, drift: float):
    """Two minutes in which either way takes 0.1 to 0.3 ms, then one in which questions wait for 10 ms and more.

    Half of the band's width bounds the error. Its lower edge is that of quick answers; its upper edge that of the last
    quick question, a minute old, and of the greatest rate, which the two quiet minutes leave open by what both ways
    took over their length, and `WANDER`. A bound by the quickest question of the minute would be 5 ms.
    """
    rng, world, quick = np.random.default_rng(seed), World(5 * MS, drift), 0.3e6

    def calm() -> tuple[int, int]:
        return int(rng.uniform(0.1e6, quick)), int(rng.uniform(0.1e6, quick))

    def queued() -> tuple[int, int]:
        return int(10 * MS + rng.exponential(20 * MS)), int(rng.uniform(0.1e6, quick))

    world.live(120, calm)
    seen = world.live(60, queued)
    assert (np.abs(seen[:, 0]) <= seen[:, 1]).all()
    passed_ns = world.now - START - 120 * SECOND
    assert np.abs(seen[:, 0]).max() <= quick + (2 * quick / (119 * SECOND) + WANDER) * passed_ns / 2


@pytest.mark.parametrize(("seed", "drift"), SEEDED)
def test_random_queues_average_out(seed: int, drift: float):
    """Either way takes 0.15 ms and an exponential wait of 5 ms in the mean.

    The quickest of the 3 n waits of n seconds is 5 ms / 3 n in the mean, and what is n seconds old is known WANDER n
    worse; their sum is least, 0.18 ms, where both are equal. Each edge is off by that, so the middle is in its worst
    case; a single round trip is off by 3.5 ms RMS.
    """
    rng, world = np.random.default_rng(seed), World(-7 * MS, drift)
    mean = 5e6

    def queued() -> tuple[int, int]:
        return int(0.15e6 + rng.exponential(mean)), int(0.15e6 + rng.exponential(mean))

    world.live(20, queued)
    seen = world.live(120, queued)
    assert (np.abs(seen[:, 0]) <= seen[:, 1]).all()
    assert np.sqrt(np.mean(seen[:, 0] ** 2)) < 2 * np.sqrt(mean * WANDER * 1e9 / BURST)


def test_a_clock_that_is_set_is_followed_at_once():
    """Round trips that contradict the past mean that a clock was set: what was before is forgotten."""
    world = World()
    world.live(5, lambda: (MS, MS))
    for jump in (3_600_000 * MS, -10 * MS):
        world.offset += jump
        world.estimator.add(world.ask(MS, MS))
        error, bound = world.off(world.now)
        assert abs(error) <= bound <= 1.1 * MS


def test_a_clock_that_is_being_slewed_is_followed():
    """A time service turns a clock's 50 ppm about: never off by more than a round trip, and right afterwards."""
    world = World()
    world.live(120, lambda: (MS // 4, MS // 4))
    world.offset, world.drift = round(-50e-6 * (world.now - START)), 50e-6
    seen = world.live(60, lambda: (MS // 4, MS // 4))
    assert np.abs(seen[:, 0]).max() <= MS // 2 + 50e-6 * SECOND
    error, bound = world.off(world.now)
    assert abs(error) <= bound + 50e-6 * SECOND


def test_old_round_trips_are_forgotten():
    world = World()
    for _ in range(40):
        world.estimator.add(world.ask(MS, MS))
        world.now += 10 * SECOND
    assert len(world.estimator._limits) <= WINDOW_NS // (10 * SECOND) + 1


def test_nothing_is_known_before_the_first_round_trip():
    assert OffsetEstimator().at(START) is None
