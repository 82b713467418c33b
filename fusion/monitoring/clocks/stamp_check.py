# SPDX-License-Identifier: BSD-3-Clause
"""Compares the stamps of a camera with the arrival of its frames: evidence of a jump in its first frame."""

from collections import deque

import numpy as np

from camera_node.arrays import Array

HISTORY, LEARNED = 64, 16  # frames of a camera, and how many of them define what is usual
RENEWED = 8  # frames, after which the usual lags are computed again
MIN_JUMP_NS = 4_000_000
MIN_IRREGULAR = 0.1  # of the interval between frames
MAX_SWAPPED = 3  # intervals by which a frame may overtake another
MAX_RATE = 0.01  # of a clock that drifts; the lags of queued frames fall by their intervals
MAX_GAP = 5  # intervals; a longer gap of a recording may be a jump


class StampCheck:
    """The lags between stamps and arrivals of one camera, and its usual interval.

    A stamp that is too late gives a lag below all earlier ones: no frame arrives before it is sent; the interval to
    the stamp before it is unusual, unlike those of queued frames that arrive together. A stamp that is too
    early gives a longer lag, as a slow network does; but then the interval between the stamps is irregular. In a
    recording without arrival times, where all lags are equal, only the interval counts.
    """

    def __init__(self) -> None:
        self._usual_ns: float | None = None  # lag before the last jump; None without arrival times
        self._stamps_jump_ns = 0.0  # of the last jump by the stamps alone: from the expected next one
        self.tolerance_ns = 0.0  # of the size of the last jump
        self._lags: deque[int] = deque(maxlen=HISTORY)
        self._stamps: deque[int] = deque(maxlen=LEARNED)
        self._quantiles, self._slope, self._age = np.zeros(4), 0.0, RENEWED

    def has_jumped(self, t_ns: int, received_ns: int) -> bool:
        """Whether the stamp `t_ns` of the next frame jumped; the frames before it are forgotten then."""
        lag, jumped = received_ns - t_ns, False
        if len(self._lags) >= LEARNED:
            first, usual, late, last = self._expected_lags()
            is_known = not first == last == lag
            is_early = lag < first - MIN_JUMP_NS and not self._is_next(t_ns)
            is_late = (lag > late + MIN_JUMP_NS or not is_known) and self._is_irregular(t_ns)
            jumped = is_early or is_late or (not is_known and self._is_after_gap(t_ns))
            if jumped:
                self._usual_ns = float(usual) if is_known else None
                self._stamps_jump_ns = t_ns - self._stamps[-1] - self._interval_ns()
                self.tolerance_ns = MIN_JUMP_NS + float(late - first) if is_known else self._interval_ns()
                self._lags.clear()
                self._stamps.clear()
                self._age = RENEWED
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
    def lag_ns(self) -> float:
        """The usual lag since the last jump."""
        return float(np.median(self._lags))

    def change_ns(self) -> float:
        """By how much the stamps jumped last: by the lags before and since; without arrival times, by the stamps."""
        return self._stamps_jump_ns if self._usual_ns is None else self._usual_ns - self.lag_ns

    def _expected_lags(self) -> Array:
        """(4,) quantiles 0, 0.5, 0.95 and 1 of the lag of the next frame: the lags so far follow their trend, as those
        of a clock that drifts do."""
        self._age += 1
        if self._age > RENEWED:
            lags = np.array(self._lags, float)
            half = len(lags) // 2
            slope = float(np.median(lags[half:]) - np.median(lags[:half])) / (len(lags) / 2)
            self._slope = slope if abs(slope) < MAX_RATE * self._interval_ns() else 0.0
            lags += self._slope * np.arange(len(lags), 0, -1)
            self._quantiles, self._age = np.percentile(lags, [0, 50, 95, 100]), 0
        return self._quantiles + self._slope * self._age

    def _interval_ns(self) -> float:
        return max(1.0, float(np.median(np.diff(np.sort(self._stamps)))))

    def _is_irregular(self, t_ns: int) -> bool:
        """Whether the time since the last stamp is no multiple of the usual interval, nor that of a swapped frame."""
        interval, since = self._interval_ns(), t_ns - self._stamps[-1]
        n = round(since / interval)
        is_new = min(abs(t_ns - stamp) for stamp in self._stamps) > MIN_IRREGULAR * interval
        if -MAX_SWAPPED <= n < 0 and is_new:
            return abs(since - n * interval) > MIN_IRREGULAR * interval
        return abs(since - max(1, n) * interval) > MIN_IRREGULAR * interval

    def _is_next(self, t_ns: int) -> bool:
        """Whether one usual interval passed since the last stamp; a lag that falls is then that of queued frames."""
        interval = self._interval_ns()
        return abs(t_ns - self._stamps[-1] - interval) <= MIN_IRREGULAR * interval

    def _is_after_gap(self, t_ns: int) -> bool:
        return t_ns - self._stamps[-1] > MAX_GAP * self._interval_ns()
