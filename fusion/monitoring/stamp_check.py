# SPDX-License-Identifier: BSD-3-Clause
"""Compares the stamps of a camera with the arrival of its frames: evidence of a jump in its first frame."""

from collections import deque
from itertools import pairwise

import numpy as np

HISTORY, LEARNED = 64, 16  # frames of a camera, and how many of them define what is usual
MIN_JUMP_NS = 4_000_000
MIN_IRREGULAR = 0.1  # of the interval between frames


class StampCheck:
    """The lags between stamps and arrivals of one camera, and its usual interval.

    A stamp that is too late gives a lag below all earlier ones: no frame arrives before it is sent. A stamp that is too
    early gives a longer lag, as a slow network does; but then the interval between the stamps is irregular.
    """

    def __init__(self) -> None:
        self._lags: deque[int] = deque(maxlen=HISTORY)
        self._stamps: deque[int] = deque(maxlen=LEARNED)

    def jump_ns(self, t_ns: int, received_ns: int) -> int | None:
        """By how much the stamp `t_ns` jumped; None if it did not, or if the arrival is unknown (0)."""
        if not received_ns:
            return None
        lag, jump = received_ns - t_ns, None
        if len(self._lags) >= LEARNED:
            usual, late = np.percentile(self._lags, [50, 95])
            is_early = lag < min(self._lags) - MIN_JUMP_NS
            is_late = lag > late + MIN_JUMP_NS and self._is_irregular(t_ns)
            jump = round(usual) - lag if is_early or is_late else None
        if jump is not None:
            self.reset()
        self._lags.append(lag)
        self._stamps.append(t_ns)
        return jump

    def reset(self) -> None:
        """Forget all frames."""
        self._lags.clear()
        self._stamps.clear()

    def _is_irregular(self, t_ns: int) -> bool:
        """Whether the time since the last stamp is no multiple of the usual interval."""
        interval = max(1.0, float(np.median([b - a for a, b in pairwise(self._stamps)])))
        since = t_ns - self._stamps[-1]
        return abs(since - max(1, round(since / interval)) * interval) > MIN_IRREGULAR * interval
