# SPDX-License-Identifier: BSD-3-Clause
"""Decides by the arrival of several frames whether the stamps of a camera jumped, where that of one shows nothing.

Intervals between stamps are free of the jitter of arrivals: of a camera with a constant rate, one irregular interval
before regular ones is a jump of the stamps, or a pause of the camera itself. A jump by J lowers the lags of all frames
since by J. Of n lags the smallest one decides: it is above x with the probability F(x)^n, where F is the share of the
earlier lags above x. Sequence numbers count the frames that a node processed, not those that the camera took, so they
are not used: a jump may differ by an interval.
"""

from collections.abc import Iterable
from dataclasses import dataclass, field
from math import floor

import numpy as np

from camera_node.foundation.arrays import Array

MIN_JUMP_NS = 4_000_000
MIN_IRREGULAR = 0.1  # of the interval between frames
MAX_SWAPPED = 12  # intervals by which a frame may overtake another
RARE = 1e-3  # probability of lags that refutes a jump, or that there was none
DECIDED, UNLIKELY = 32, 0.05  # frames, after which a jump counts if lags without one were less probable


@dataclass(slots=True)
class UndecidedJump:
    """An irregular interval between the stamps of a camera.

    Attributes:
        before: (K,) lags of the earlier frames, ns.
        interval_ns: between the stamps of frames.
        stamp_ns: of the first frame after the irregular interval.
        jumps_ns: by which the stamps may have jumped.
        stamps, lags: of the frames since that continue `stamp_ns`.
    """

    before: Array
    interval_ns: float
    stamp_ns: int
    jumps_ns: tuple[float, ...]
    stamps: list[int] = field(default_factory=list)
    lags: list[int] = field(default_factory=list)

    @classmethod
    def of(cls, stamps: Iterable[int], lags: Iterable[int], t_ns: int) -> "UndecidedJump | None":
        """From earlier stamps and lags and the next stamp `t_ns`; None unless that one alone is irregular."""
        times = sorted(stamps)
        steps, interval = np.diff(times), usual_interval(times)
        if (np.abs(steps - np.round(steps / interval) * interval) > MIN_IRREGULAR * interval).any():
            return None
        since = float(t_ns - times[-1])
        n = max(1, floor(since / interval))
        jumps = [since - n * interval, since - (n + 1) * interval] if since > interval else [since - interval]
        if min(map(abs, jumps)) < max(MIN_JUMP_NS, MIN_IRREGULAR * interval):
            return None
        return cls(np.array(list(lags), float), interval, t_ns, tuple(jumps))

    @property
    def jump_ns(self) -> float | None:
        """The jump that agrees best with the lags; None if a larger one is certain."""
        shown = float(self.before.min()) - min(self.lags)
        return min(self.jumps_ns, key=lambda jump: abs(shown - jump), default=None)

    def decide(self, t_ns: int, lag_ns: int) -> bool | None:
        """Whether the stamps jumped, by the next frame too; None while that is undecided."""
        if not self._is_regular(t_ns - self.stamp_ns):
            return None if self._is_overtaken(t_ns) else False
        self.stamps.append(t_ns)
        self.lags.append(lag_ns)
        jumped = self._probability(0.0) < RARE
        self.jumps_ns = tuple(jump for jump in self.jumps_ns if not self._is_refuted(jump))
        if jumped or not self.jumps_ns:
            return jumped
        return None if len(self.lags) < DECIDED else self._probability(0.0) < UNLIKELY

    def _is_overtaken(self, t_ns: int) -> bool:
        """Whether a frame from before the irregular interval arrives only now."""
        jump = min(self.jumps_ns)
        return t_ns < self.stamp_ns - min(0.0, jump) and self._is_regular(t_ns - self.stamp_ns + jump)

    def _is_regular(self, since_ns: float) -> bool:
        off_ns = since_ns - round(since_ns / self.interval_ns) * self.interval_ns
        return abs(off_ns) <= MIN_IRREGULAR * self.interval_ns

    def _is_refuted(self, jump_ns: float) -> bool:
        """Whether the lags since do not agree with a jump by this: they would be rare or above all earlier ones."""
        is_above = min(self.lags) + jump_ns > self.before.max() + MIN_JUMP_NS
        return is_above or self._probability(jump_ns) < RARE

    def _probability(self, jump_ns: float) -> float:
        """Of a smallest lag since as large as it is, after a jump by this; 0 below all earlier lags."""
        least = min(self.lags) + jump_ns
        if least < self.before.min() - MIN_JUMP_NS:
            return 0.0
        n_above = np.count_nonzero(self.before > least - MIN_JUMP_NS)
        return ((n_above + 1) / (len(self.before) + 1)) ** len(self.lags)


def usual_interval(stamps: Iterable[int]) -> float:
    """The median interval between stamps in any order, ns; at least 1."""
    return max(1.0, float(np.median(np.diff(sorted(stamps)))))
