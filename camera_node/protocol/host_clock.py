# SPDX-License-Identifier: BSD-3-Clause
"""This machine's clocks: which one it is, and Unix time beside the monotonic clock."""

import time
from functools import cache
from pathlib import Path

BOOT_ID = Path("/proc/sys/kernel/random/boot_id")
READINGS = 3


@cache
def clock_id() -> str:
    """The name of this machine's clock, which programs in containers share; empty where it has none."""
    try:
        return BOOT_ID.read_text().strip()
    except OSError:
        return ""


def unix_ahead_ns() -> int:
    """Unix time less the monotonic clock.

    Each reading stands between two of the monotonic clock, and the quickest of a few counts: a thread that has to wait
    between the two clocks would be wrong by as long.
    """
    readings = [(time.monotonic_ns(), time.time_ns(), time.monotonic_ns()) for _ in range(READINGS)]
    before, unix, after = min(readings, key=lambda reading: reading[2] - reading[0])
    return unix - (before + after) // 2
