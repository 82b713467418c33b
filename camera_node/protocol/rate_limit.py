# SPDX-License-Identifier: BSD-3-Clause
"""Limits how often something happens, by a token bucket."""

import threading
import time


class RateLimit:
    """Passes `rate_hz` events a second in the long run, and `burst` of them at once. Safe to use from several threads.

    Args:
        rate_hz: events a second; may be changed later.
        burst: events that may happen at once.
    """

    def __init__(self, rate_hz: float, burst: float) -> None:
        self.rate_hz, self.burst = rate_hz, burst
        self._tokens = burst
        self._at_s = time.monotonic()
        self._lock = threading.Lock()

    def passes(self) -> bool:
        """Whether an event may happen now; then it counts."""
        with self._lock:
            now_s = time.monotonic()
            self._tokens = min(self.burst, self._tokens + self.rate_hz * (now_s - self._at_s))
            self._at_s = now_s
            if self._tokens < 1.0:
                return False
            self._tokens -= 1.0
            return True
