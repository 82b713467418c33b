# SPDX-License-Identifier: BSD-3-Clause
"""Stamps that contradict each other where no majority decides which of them are wrong: all get a common noise."""

import logging

log = logging.getLogger("fusion")

UNDECIDED_NS = 10_000_000_000  # between reports that no majority decides
MAX_SPREAD_S = 0.1  # standard deviation of all stamps while cameras contradict each other
HELD_NS = 3_000_000_000  # after such a contradiction no camera counts as moved


class UndecidedStamps:
    """The last contradiction between the stamps of cameras that was not decided.

    Args:
        names: of the cameras.
    """

    def __init__(self, names: tuple[str, ...]) -> None:
        self._names = names
        self._noted_ns: int | None = None
        self._reported_ns: int | None = None
        self._spread_s = 0.0

    def note(self, spread_s: float, now_ns: int) -> None:
        """Note a contradiction of stamps that differ by a standard deviation of `spread_s`; reported now and then."""
        self._noted_ns, self._spread_s = now_ns, min(spread_s, MAX_SPREAD_S)
        if self._reported_ns is None or now_ns > self._reported_ns + UNDECIDED_NS:
            self._reported_ns = now_ns
            log.warning(
                "the stamps of the cameras contradict each other, and it is not clear which of them are wrong; "
                "check the clocks of %s",
                ", ".join(self._names),
            )

    def holds(self, now_ns: int) -> bool:
        """Whether the contradiction is recent: no camera counts as moved then."""
        return self._noted_ns is not None and now_ns < self._noted_ns + HELD_NS

    def sigma_s(self, now_ns: int) -> float:
        """The standard deviation of all stamps."""
        return self._spread_s if self.holds(now_ns) else 0.0
