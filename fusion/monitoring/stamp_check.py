# SPDX-License-Identifier: BSD-3-Clause
"""Compares the stamps of a camera with the arrival of its frames: evidence of a jump in its first frame."""

from collections import deque

import numpy as np

HISTORY, LEARNED = 64, 16  # frames of a camera, and how many of them define what is usual
MIN_JUMP_NS = 4_000_000
MIN_IRREGULAR = 0.1  # of the interval between frames
MAX_GAP = 5  # intervals; a longer gap of a recording may be a jump


class StampCheck:
    """The lags between stamps and arrivals of one camera, and its usual interval.

    A stamp that is too late gives a lag below all earlier ones: no frame arrives before it is sent. A stamp that is too
    early gives a longer lag, as a slow network does; but then the interval between the stamps is irregular. In a
    recording without arrival times, where all lags are equal, only the interval counts.
    """

    def __init__(self) -> None:
        self._lags: deque[int] = deque(maxlen=HISTORY)
        self._stamps: deque[int] = deque(maxlen=LEARNED)

    def jump_ns(self, t_ns: int, received_ns: int) -> int | None:
        """By how much the stamp `t_ns` jumped, 0 if this is unknown; None if nothing shows that it did."""
        lag, jump = received_ns - t_ns, None
        if len(self._lags) >= LEARNED:
            first, usual, late, last = np.percentile(self._lags, [0, 50, 95, 100])
            is_early = lag < first - MIN_JUMP_NS
            is_late = lag > late + MIN_JUMP_NS and self._is_irregular(t_ns)
            if is_early or is_late:
                jump = round(usual) - lag
            elif first == last == lag and (self._is_irregular(t_ns) or self._is_after_gap(t_ns)):
                jump = 0
        if jump is not None:
            self.reset()
        self._lags.append(lag)
        self._stamps.append(t_ns)
        return jump

    def reset(self) -> None:
        """Forget all frames."""
        self._lags.clear()
        self._stamps.clear()

    def _interval_ns(self) -> float:
        return max(1.0, float(np.median(np.diff(self._stamps))))

    def _is_irregular(self, t_ns: int) -> bool:
        """Whether the time since the last stamp is no multiple of the usual interval."""
        interval, since = self._interval_ns(), t_ns - self._stamps[-1]
        return abs(since - max(1, round(since / interval)) * interval) > MIN_IRREGULAR * interval

    def _is_after_gap(self, t_ns: int) -> bool:
        return t_ns - self._stamps[-1] > MAX_GAP * self._interval_ns()
