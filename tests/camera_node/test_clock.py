# SPDX-License-Identifier: BSD-3-Clause
"""The clock: the truth lies within the bound, whatever the network does."""

from hypothesis import given
from hypothesis import strategies as st

from camera_node.clock import SLEW, WINDOW_NS, OffsetEstimator, RoundTrip

START = 1_700_000_000_000_000_000
MS = 1_000_000

delays = st.lists(
    st.tuples(st.integers(0, 300 * MS), st.integers(0, 300 * MS), st.integers(MS, 20_000 * MS)),
    min_size=1,
    max_size=60,
)
offsets = st.integers(-(10**15), 10**15)
drifts = st.floats(-50e-6, 50e-6)


class World:
    """A server's clock: `offset` ahead of this machine's at the start, and running `drift` faster."""

    def __init__(self, offset: int, drift: float = 0.0) -> None:
        self.offset, self.drift, self.now = offset, drift, START

    def true_offset(self, t_ns: int) -> float:
        return self.offset + self.drift * (t_ns - START)

    def ask(self, there: int, back: int) -> RoundTrip:
        """A question that takes `there` ns to the server and `back` ns from it."""
        sent, met = self.now, self.now + there
        self.now = met + back
        return RoundTrip(sent, met + round(self.true_offset(met)), self.now)


@given(offsets, drifts, delays)
def test_the_truth_lies_within_the_bound(offset: int, drift: float, delays: list[tuple[int, int, int]]):
    """With any delays, however asymmetric, and 50 ppm of drift, at every round trip and between them.

    1 ns is for rounding the server's time.
    """
    world, estimator = World(offset, drift), OffsetEstimator()
    for there, back, pause in delays:
        estimator.add(world.ask(there, back))
        for now in (world.now, world.now + pause // 2, world.now + pause):
            estimate, bound = estimator.at(now) or (0, -1)
            assert abs(estimate - world.true_offset(now)) <= bound + 1
        world.now += pause


@given(offsets, drifts, delays)
def test_the_estimate_slews(offset: int, drift: float, delays: list[tuple[int, int, int]]):
    """While nobody sets a clock, the estimate moves no faster than SLEW allows: stamps never jump or go back."""
    world, estimator = World(offset, drift), OffsetEstimator()
    last: tuple[int, float] | None = None
    for there, back, pause in delays:
        estimator.add(world.ask(there, back))
        for now in (world.now, world.now + pause // 3, world.now + pause):
            estimate, _ = estimator.at(now) or (0.0, 0.0)
            if last:
                assert abs(estimate - last[1]) <= SLEW * (now - last[0]) + 1
            last = now, estimate
        world.now += pause


def test_the_quickest_round_trip_decides():
    """A slow asymmetric answer among quick ones moves nothing: the bound stays that of the quick ones."""
    world, estimator = World(5 * MS), OffsetEstimator()
    for there, back in ((MS, MS), (200 * MS, 0), (0, 200 * MS)):
        estimator.add(world.ask(there, back))
    estimate, bound = estimator.at(world.now) or (0, 0)
    assert estimate == 5 * MS
    assert bound < 1.1 * MS


def test_a_clock_that_is_set_is_followed_at_once():
    """A round trip that contradicts the past by more than both bounds means that a clock was set."""
    world, estimator = World(0), OffsetEstimator()
    for _ in range(5):
        estimator.add(world.ask(MS, MS))
        world.now += 1000 * MS
    world.offset = 3_600_000 * MS
    estimator.add(world.ask(MS, MS))
    estimate, bound = estimator.at(world.now) or (0, 0)
    assert abs(estimate - world.offset) <= bound <= 1.1 * MS


def test_old_round_trips_are_forgotten():
    world, estimator = World(0), OffsetEstimator()
    for _ in range(200):
        estimator.add(world.ask(MS, MS))
        world.now += 1000 * MS
    assert len(estimator._trips) <= WINDOW_NS // (1000 * MS) + 1


def test_nothing_is_known_before_the_first_round_trip():
    estimator = OffsetEstimator()
    assert estimator.at(START) is None
    estimator.add(RoundTrip(START, START, START - 1))
    assert estimator.at(START) is None
