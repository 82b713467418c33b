# SPDX-License-Identifier: BSD-3-Clause
"""Measures the rates of the cameras' clocks against the server's, by the arrivals of their frames.

The lag of a frame, arrival minus stamp, is its delay and the error of its stamp. Queues only add to a delay, so the
least lag in a second is steady to a tenth of a millisecond, and its slope is the rate of the clock: without any motion
of robots. A lag above the least one so far may be a delay that grew, as by congestion, so it measures nothing,
but the clock may be as slow as that; one that falls again, not below those before, neither.
docs/design/time_offsets.md, section 3, has the equations.
"""

import math
from collections import defaultdict, deque
from dataclasses import dataclass, field
from itertools import pairwise
from statistics import median

from fusion.model.frames import CalibratedFrame
from fusion.monitoring.stamp_check import EXACT_NS
from fusion.rig_graph.clock_walk import CHANGED_SIGMA

WINDOW_NS = 1_000_000_000  # in which the least lag counts: of 30 frames at 30 Hz
FEWEST = 5  # frames in it
# Changes from one window to the next by which the next one is predicted, at least and at most.
LEARNED = 4, 9
REMEMBERED = 60  # windows, a minute: a queue that lasts longer looks like a longer way
CRYSTAL = 1e-4  # rate by which the least lag may rise, and is still that of the clock
CERTAIN = 3.0  # standard deviations by which a lag is above the least one
# The standard deviation of a change over the median difference of successive ones: 1.4826 / 2^1/2 of normal deviates,
# times that of Student's distribution with four degrees of freedom, 2^1/2, since few changes are known.
OF_MEDIAN = 1.4826


@dataclass(frozen=True, slots=True)
class ArrivalRate:
    """The rate of a clock against the server's clock, and its standard deviation; infinite if the clock may have that
    rate, but delays may have grown instead."""

    rate: float
    sigma: float


@dataclass(slots=True)
class _Lags:
    """The lags of one camera.

    Attributes:
        window, n, least_ns: number of the present window, its frames, and the least of their lags, at its begin by
            `rate`.
        rate, turn_ns: of the lags, as it is known, and what another rate than in the window before may change.
        floors: (window, least lag) of those before, oldest first.
        changes: from one window to the next, ns, of those that measured the rate.
    """

    window: int = 0
    n: int = 0
    least_ns: float = 0.0
    rate: float = 0.0
    turn_ns: float = 0.0
    floors: deque[tuple[int, float]] = field(default_factory=lambda: deque(maxlen=REMEMBERED))
    changes: deque[float] = field(default_factory=lambda: deque(maxlen=LEARNED[1]))
    is_late: bool = False  # whether the last window was above those before

    def add(self, arrived_ns: int, lag_ns: int) -> ArrivalRate | None:
        window, found = arrived_ns // WINDOW_NS, None
        if window != self.window:
            found = self._end() if self.n >= FEWEST else None
            self.window, self.n, self.least_ns = window, 0, math.inf
            rate = median(self.changes) / WINDOW_NS if len(self.changes) >= LEARNED[0] else 0.0
            self.rate, self.turn_ns = rate, abs(rate - self.rate) * WINDOW_NS
        at_begin_ns = lag_ns - self.rate * (arrived_ns - window * WINDOW_NS)
        self.n, self.least_ns = self.n + 1, min(self.least_ns, at_begin_ns)
        return found

    def _end(self) -> ArrivalRate | None:
        """End a window: what its change from the one before shows, by the scatter of the changes before."""
        earlier, was_late, known = list(self.floors), self.is_late, list(self.changes)
        self.floors.append((self.window, self.least_ns))
        if not earlier or earlier[-1][0] != self.window - 1:
            return None
        change_ns = self.least_ns - earlier[-1][1]
        if len(known) < LEARNED[0]:
            self.changes.append(change_ns)
            return None
        # By the median, so that neither a delay that changed once nor a clock that began to drift makes it large.
        sigma_ns = max(EXACT_NS, OF_MEDIAN * median(abs(b - a) for a, b in pairwise(known)))
        floor_ns = min(lag + CRYSTAL * WINDOW_NS * (self.window - k) for k, lag in earlier)
        falls_back = change_ns < -CERTAIN * sigma_ns and self.least_ns > min(lag for _, lag in earlier)
        self.is_late = self.least_ns > floor_ns + CERTAIN * sigma_ns
        if self.is_late:
            may_be_slow = change_ns > CERTAIN * sigma_ns
            return ArrivalRate(change_ns / WINDOW_NS, math.inf) if may_be_slow else None
        if was_late or falls_back:
            return None
        self.changes.append(change_ns)
        return ArrivalRate(change_ns / WINDOW_NS, math.hypot(sigma_ns, self.turn_ns) / WINDOW_NS)


class ArrivalRates:
    """The rates of the clocks of all cameras, by the arrivals of their frames."""

    def __init__(self) -> None:
        self._lags = defaultdict[str, _Lags](_Lags)

    def forget(self, name: str) -> None:
        """The stamps of a camera jumped."""
        self._lags.pop(name, None)

    def add(self, frame: CalibratedFrame) -> ArrivalRate | None:
        """Take the next frame of a camera; what its clock's rate is, in the stamps that the camera published, where a
        window ended that shows it. A clock is not 1 % fast; the delay changed then."""
        if not (frame.sent_ns and frame.received_ns):  # no arrivals, or those that stamps were taken for
            return None
        found = self._lags[frame.camera].add(frame.received_ns, frame.received_ns - frame.stamp_ns)
        return found if found is not None and abs(found.rate) < CHANGED_SIGMA[1] else None
