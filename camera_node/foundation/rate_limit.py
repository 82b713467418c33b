# SPDX-License-Identifier: BSD-3-Clause
"""Limits how often something happens, by a token bucket."""

import threading
import time
from collections.abc import Callable


class RateLimit:
    """Passes `rate_hz` events a second in the long run, and `burst` of them at once. Safe to use from several threads.

    Args:
        rate_hz: events a second; may be changed later.
        burst: events that may happen at once.
        clock: a time that is never set, s.
    """

    def __init__(self, rate_hz: float, burst: float, clock: Callable[[], float] = time.monotonic) -> None:
        self.rate_hz, self.burst = rate_hz, burst
        self._clock = clock
        self._tokens = burst
        self._at_s = clock()
        self._lock = threading.Lock()

    def passes(self) -> bool:
        """Whether an event may happen now; then it counts."""
        with self._lock:
            if self._refill() < 1.0:
                return False
            self._tokens -= 1.0
            return True

    def take(self, events: float = 1.0) -> None:
        """Count events that happen in any case; later ones wait until as many would have been passed."""
        with self._lock:
            self._tokens = self._refill() - events

    def left(self) -> float:
        """How many events may happen now; negative if more were taken than may happen."""
        with self._lock:
            return self._refill()

    def due_s(self) -> float:
        """When the next event may happen, by the clock."""
        with self._lock:
            return self._at_s + max(0.0, 1.0 - self._tokens) / self.rate_hz

    def _refill(self) -> float:
        now_s = self._clock()
        self._tokens = min(self.burst, self._tokens + self.rate_hz * (now_s - self._at_s))
        self._at_s = now_s
        return self._tokens
