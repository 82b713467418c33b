# SPDX-License-Identifier: BSD-3-Clause
"""Compares the stamps of a camera with the arrival of its frames: evidence of a jump in its first frame."""

from collections import deque
from statistics import median

import numpy as np

from fusion.monitoring.clocks.undecided_jump import (
    MAX_SWAPPED,
    MIN_IRREGULAR,
    MIN_JUMP_NS,
    UndecidedJump,
    usual_interval,
)

HISTORY, LEARNED = 64, 16  # frames of a camera, and how many of them define what is usual
RENEWED = 8  # frames, after which the usual lags are computed again
MAX_RATE = 0.01  # of a clock that drifts; the lags of queued frames fall by their intervals
# Of the usual lag above the smallest: a lag below all earlier ones by less is none of a jump.
EARLY_SHARE = 0.25
MAX_GAP = 5  # intervals; a longer gap of a recording may be a jump


class StampCheck:
    """The lags between stamps and arrivals of one camera, and its usual interval.

    A stamp that is too late gives a lag below all earlier ones: no frame arrives before it is sent; the interval to
    the stamp before it is unusual, unlike those of queued frames that arrive together. One irregular interval after
    regular ones is a jump, unless the arrivals of this frame and the next ones refute that (`UndecidedJump`). In a
    recording without arrival times, where all lags are equal, only the interval counts.
    """

    def __init__(self) -> None:
        self._usual_ns: float | None = None  # lag before the last jump; None without arrival times
        self._jump_ns: float | None = None  # of the last jump by the stamps alone; None if lags show it
        self._undecided: UndecidedJump | None = None
        self.tolerance_ns = 0.0  # of the size of the last jump
        self._lags: deque[int] = deque(maxlen=HISTORY)
        self._stamps: deque[int] = deque(maxlen=LEARNED)
        self._quantiles, self._slope, self._age = (0.0, 0.0, 0.0), 0.0, RENEWED
        self._interval_ns = 1.0  # between stamps

    def has_jumped(self, t_ns: int, received_ns: int) -> bool:
        """Whether the stamp `t_ns` of the next frame shows a jump; the frames before the jump are forgotten then."""
        lag = received_ns - t_ns
        if self._undecided is not None:
            jumped = self._decide(self._undecided, t_ns, lag)
        else:
            jumped = len(self._lags) >= LEARNED and self._is_jump(t_ns, lag)
        self._lags.append(lag)
        self._stamps.append(t_ns)
        return jumped

    @property
    def is_learned(self) -> bool:
        """Whether enough frames arrived to say what is usual."""
        return len(self._lags) >= LEARNED

    @property
    def is_timed(self) -> bool:
        """Whether arrivals show the size of the last jump."""
        return self._usual_ns is not None

    @property
    def is_undecided(self) -> bool:
        """Whether the stamps may have jumped just now."""
        return self._undecided is not None

    @property
    def lag_ns(self) -> float:
        """The usual lag since the last jump."""
        return float(np.median(self._lags))

    def change_ns(self) -> float:
        """By how much the stamps jumped last: by the stamps where these tell it, else by the lags before and since."""
        if self._jump_ns is not None:
            return self._jump_ns
        return 0.0 if self._usual_ns is None else self._usual_ns - self.lag_ns

    def least_change_ns(self) -> float | None:
        """The smallest jump that an undecided one may be; None without any."""
        return min(map(abs, self._undecided.jumps_ns), default=0.0) if self._undecided else None

    def accept(self) -> None:
        """The stamps since an undecided jump are right."""
        if self._undecided is not None:
            self._restart(self._undecided)

    def _is_jump(self, t_ns: int, lag: int) -> bool:
        """Whether the next frame alone shows a jump; it may leave one undecided."""
        first, usual, last = self._expected_lags()
        is_known, is_irregular = not first == last == lag, self._is_irregular(t_ns)
        if is_known and is_irregular:
            self._undecided = UndecidedJump.of(self._stamps, self._lags, t_ns)
            if self._undecided is not None:
                return self._decide(self._undecided, t_ns, lag)
        margin_ns = MIN_JUMP_NS + EARLY_SHARE * (usual - first)
        is_early = lag < first - margin_ns and not self._is_next(t_ns)
        if not is_early and (is_known or not (is_irregular or self._is_after_gap(t_ns))):
            return False
        self._usual_ns = float(usual) if is_known else None
        self._jump_ns = None if is_known else t_ns - self._stamps[-1] - self._interval_ns
        self.tolerance_ns = MIN_JUMP_NS + float(last - first) if is_known else self._interval_ns
        self._forget()
        return True

    def _decide(self, undecided: UndecidedJump, t_ns: int, lag: int) -> bool:
        """Whether an undecided jump is certain with the next frame."""
        jumped = undecided.decide(t_ns, lag)
        if jumped:
            self._usual_ns, self._jump_ns = float(np.median(undecided.before)), undecided.jump_ns
            self.tolerance_ns = MIN_JUMP_NS + float(np.ptp(undecided.before))
            self._restart(undecided)
            self._lags.pop()  # which `has_jumped` adds
            self._stamps.pop()
        elif jumped is not None:
            self._undecided = None
        return bool(jumped)

    def _restart(self, undecided: UndecidedJump) -> None:
        """Forget the frames before an undecided jump."""
        self._forget()
        self._lags.extend(undecided.lags)
        self._stamps.extend(undecided.stamps)

    def _forget(self) -> None:
        """Forget all frames."""
        self._lags.clear()
        self._stamps.clear()
        self._undecided, self._age = None, RENEWED

    def _expected_lags(self) -> tuple[float, float, float]:
        """The quantiles 0, 0.5 and 1 of the lag of the next frame: the lags so far follow their trend, as those
        of a clock that drifts do."""
        self._age += 1
        if self._age > RENEWED:
            self._interval_ns = usual_interval(self._stamps)
            lags, n = list(self._lags), len(self._lags)
            slope = (median(lags[n // 2 :]) - median(lags[: n // 2])) / (n / 2)
            self._slope = slope if abs(slope) < MAX_RATE * self._interval_ns else 0.0
            now = sorted(lag + self._slope * (n - k) for k, lag in enumerate(lags))
            self._quantiles, self._age = (now[0], median(now), now[-1]), 0
        first, usual, last = self._quantiles
        since = self._slope * self._age
        return first + since, usual + since, last + since

    def _is_irregular(self, t_ns: int) -> bool:
        """Whether the time since the last stamp is no multiple of the usual interval, nor that of a swapped frame."""
        interval, since = self._interval_ns, t_ns - self._stamps[-1]
        n = round(since / interval)
        if (
            -MAX_SWAPPED <= n < 0
            and min(abs(t_ns - stamp) for stamp in self._stamps) > MIN_IRREGULAR * interval
        ):
            return abs(since - n * interval) > MIN_IRREGULAR * interval
        return abs(since - max(1, n) * interval) > MIN_IRREGULAR * interval

    def _is_next(self, t_ns: int) -> bool:
        """Whether one usual interval passed since the last stamp; a lag that falls is then that of queued frames."""
        interval = self._interval_ns
        return abs(t_ns - self._stamps[-1] - interval) <= MIN_IRREGULAR * interval

    def _is_after_gap(self, t_ns: int) -> bool:
        return t_ns - self._stamps[-1] > MAX_GAP * self._interval_ns
