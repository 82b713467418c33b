# SPDX-License-Identifier: BSD-3-Clause
"""Identifies this machine's clock and compares Unix time with the monotonic clock."""

import time
from collections.abc import Callable
from functools import cache
from pathlib import Path

BOOT_ID = Path("/proc/sys/kernel/random/boot_id")
READINGS = 3  # of both clocks; the fastest is used


@cache
def clock_id() -> str:
    """The boot id, which names the clock that all containers of this machine share; empty where it is unavailable."""
    try:
        return BOOT_ID.read_text().strip()
    except OSError:
        return ""


def unix_ahead_ns(read_ns: Callable[[], int] = time.monotonic_ns) -> int:
    """Measure Unix time minus another clock that `read_ns` reads, the monotonic one unless given.

    Reads Unix time between two readings of that clock and uses the fastest of `READINGS` attempts, because an
    interruption between the readings is an error of its length.
    """
    readings = [(read_ns(), time.time_ns(), read_ns()) for _ in range(READINGS)]
    before, unix, after = min(readings, key=lambda reading: reading[2] - reading[0])
    return unix - (before + after) // 2
