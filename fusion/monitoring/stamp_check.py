# SPDX-License-Identifier: BSD-3-Clause
"""Finds jumps of a camera's stamps by two measurements of each frame; docs/design/time_offsets.md, section 2.

The interval to the stamp before is free of the delays of arrivals: of a camera with a constant rate it is a multiple of
the usual one, else the stamps jumped or the camera paused. The lag, arrival minus stamp, shows which: stamps that jump
ahead by J lower it by J, and no frame arrives before it was sent; an interval below the usual one is no pause.

How far stamps are from a constant rate is their standard deviation: sensors run by crystals, drivers and programs that
take the time when a frame arrives do not.
"""

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import accumulate, pairwise
from statistics import linear_regression, median

HISTORY, LEARNED = 64, 16  # frames of a camera, and how many of them define what is usual
MIN_JUMP_NS = 4_000_000  # of lags, which vary with the time of detection
EARLY_SHARE = 0.25  # of the usual lag above the smallest, by which the next one may be smaller still
MIN_IRREGULAR = 0.1  # of the interval between frames
MISSED = 32  # most intervals in the usual step between stamps, of a busy machine
EXACT_NS = 100_000  # of an interval; less makes no difference to robots


@dataclass(frozen=True, slots=True)
class StampJump:
    """By how much stamps jumped ahead, and the standard deviation; 0, and the possible jump, if they may have."""

    ahead_ns: float
    sigma_ns: float


class StampCheck:
    """The last stamps and lags of one camera.

    Attributes:
        sigma_ns: standard deviation of single stamps by the last `LEARNED` of them; 0 before.
    """

    def __init__(self) -> None:
        self.sigma_ns = 0.0
        self._stamps: deque[int] = deque(maxlen=LEARNED)
        self._lags: deque[int] = deque(maxlen=HISTORY)

    def add(self, t_ns: int, received_ns: int, least_lag_ns: float = 0.0) -> StampJump | None:
        """Whether the stamp of the next frame shows a jump, or may; the frames before it are forgotten then.

        Args:
            t_ns, received_ns: its stamp and its arrival.
            least_lag_ns: between these, if the frame is not to arrive before it was sent: the correction of the stamps.
        """
        lag, jump = received_ns - t_ns, None
        if len(self._lags) >= LEARNED:
            stamps = sorted(self._stamps)
            steps = [after - before for before, after in pairwise(stamps)]
            interval = _interval(steps)
            self.sigma_ns = _irregularity(steps, interval)
            jump = self._jump(t_ns, lag, least_lag_ns, steps, interval)
        if jump is not None:
            self._stamps.clear()
            self._lags.clear()
        self._stamps.append(t_ns)
        self._lags.append(lag)
        return jump

    def _jump(
        self, t_ns: int, lag: int, least_lag: float, steps: Sequence[int], interval: float
    ) -> StampJump | None:
        since = t_ns - max(self._stamps)
        if abs(since - interval) <= MIN_IRREGULAR * interval:
            return None  # the next frame; the lags of queued ones fall
        low, usual, high = min(self._lags), median(self._lags), max(self._lags)
        least, most = low - lag - MIN_JUMP_NS - EARLY_SHARE * (usual - low), high - lag + MIN_JUMP_NS
        if low == high == lag:  # a recording without arrival times
            least, most = -math.inf, math.inf
        is_early, is_late = least > 0, most < 0 and since < interval
        # Without that, a queue that ended, for which frames were skipped, looks like a jump.
        is_before_sent = is_early and lag < least_lag
        if not all(_is_multiple(step, interval) for step in steps):
            return StampJump(usual - lag, high - low + MIN_JUMP_NS) if is_before_sent else None
        if not is_before_sent and self._is_regular(t_ns, interval):
            return None
        longest = since - interval  # jump ahead; a smaller one if frames are missing too
        precision = max(abs(step - round(step / interval) * interval) for step in steps) + 1
        if is_late:  # if frames are missing too, stamps jumped back by more, as far as the lag allows
            precision = precision if longest - interval < least else longest - least
            return StampJump(longest, precision) if longest >= least else None
        if least == -math.inf:
            return StampJump(0.0, max(since % interval, -since % interval))
        ahead = least + (since - least) % interval
        if is_early and ahead >= MIN_JUMP_NS:
            return StampJump(ahead, precision if ahead + interval > min(most, longest) else interval)
        return (
            StampJump(0.0, max(since % interval, -since % interval)) if ahead <= min(most, longest) else None
        )

    def _is_regular(self, t_ns: int, interval: float) -> bool:
        """Whether a stamp follows the others by multiples of the usual interval, or fills a gap: the frame is late."""
        since = t_ns - max(self._stamps)
        is_new = min(abs(t_ns - stamp) for stamp in self._stamps) > MIN_IRREGULAR * interval
        return _is_multiple(since, interval) and is_new and t_ns > min(self._stamps) - interval


def _interval(steps: Sequence[int]) -> float:
    """The usual one between frames, of which all steps are multiples if frames are missing."""
    usual = max(1.0, median(steps))
    if _departure(steps, usual) <= MIN_IRREGULAR * usual:
        return usual  # as of most frames
    intervals = (usual / n for n in range(1, MISSED + 1))
    return next((T for T in intervals if all(_is_multiple(step, T) for step in steps)), usual)


def _irregularity(steps: Sequence[int], interval: float) -> float:
    """Standard deviation of stamps with these steps from the best constant rate."""
    if _departure(steps, interval) < EXACT_NS:
        return 0.0
    counts = [max(1, round(step / interval)) for step in steps]
    if all(abs(step - n * interval) < EXACT_NS for step, n in zip(steps, counts, strict=True)):
        return 0.0
    numbers, stamps = list(accumulate(counts, initial=0)), list(accumulate(steps, initial=0))
    rate, start = linear_regression(numbers, stamps)
    squares = sum((t - start - rate * n) ** 2 for n, t in zip(numbers, stamps, strict=True))
    return math.sqrt(squares / (len(stamps) - 2))


def _departure(steps: Sequence[int], interval: float) -> float:
    """How far the steps are from one interval."""
    return max(max(steps) - interval, interval - min(steps))


def _is_multiple(step: float, interval: float) -> bool:
    n = round(step / interval)
    return n != 0 and abs(step - n * interval) <= MIN_IRREGULAR * interval
