# SPDX-License-Identifier: BSD-3-Clause
"""The growth of a program's memory with its confidence interval, from all its lives in a run.

The median of the slopes between all pairs of samples of the same life, and the interval from Kendall's statistic (Sen
1968; over several lives: Gilbert 1987, section 16.4.2). Each sample is the smallest of some seconds, because buffers
come and go, and what is freed stays resident until `return_freed_memory` returns it. Only anonymous memory counts: the
pages of libraries are read once.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from camera_node.foundation.arrays import Array
from camera_node.foundation.program import PERIOD_S

WARM_UP_S = 120.0  # of a life, which does not count: imports, caches and the allocator's arenas fill
# Time of which the smallest value counts: a program returns freed memory only periodically.
SAMPLE_S = 2 * PERIOD_S
MIN_MINUTES = 4.0  # of all lives after the warm-up, from which a growth is computed
NORMAL = 1.96  # two-sided quantile of 95 %
MAX_MB_PER_MIN = 0.5  # that the interval must not exclude


@dataclass(frozen=True)
class Growth:
    """MB a minute, the bounds of its 95 % interval, and the minutes after the warm-up that it was measured in."""

    mb_per_min: float
    low: float
    high: float
    minutes: float

    @property
    def is_excessive(self) -> bool:
        """Whether the memory certainly grows by more than `MAX_MB_PER_MIN`."""
        return self.low > MAX_MB_PER_MIN

    def __str__(self) -> str:
        interval = f"{self.low:.2f} to {self.high:.2f}"
        return f"{self.mb_per_min:.2f} MB a minute (95 %: {interval}; {self.minutes:.1f} min)"


def anonymous_mb(pid: int) -> float:
    """The resident anonymous memory of a process, 1e6 bytes.

    Raises:
        OSError: the process is over.
        StopIteration: it has ended, and its parent has not yet waited for it.
    """
    lines = Path(f"/proc/{pid}/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith("RssAnon:")) * 1024e-6


def growth(lives: Sequence[Array]) -> Growth | None:
    """The growth over all lives, each (N, 2): age in s and MB; None if they are too short."""
    steady = [life for life in map(_smallest, lives) if len(life) > 1]
    minutes = sum(life[-1, 0] - life[0, 0] for life in steady) / 60
    if minutes < MIN_MINUTES:
        return None
    slopes = np.sort(np.concatenate([_slopes(life) for life in steady])) * 60
    n = np.array([len(life) for life in steady])
    spread = NORMAL * float(np.sqrt(np.sum(n * (n - 1) * (2 * n + 5) / 18)))
    low, high = (round((len(slopes) + sign * spread) / 2) for sign in (-1, 1))
    low, high = max(low, 0), min(high, len(slopes) - 1)
    return Growth(float(np.median(slopes)), float(slopes[low]), float(slopes[high]), minutes)


def _smallest(life: Array) -> Array:
    """(M, 2) the smallest sample of each `SAMPLE_S` after the warm-up."""
    steady = life[life[:, 0] > WARM_UP_S] if len(life) else np.empty((0, 2))
    number = (steady[:, 0] // SAMPLE_S).astype(int)
    rows = [np.flatnonzero(number == k) for k in np.unique(number)]
    return np.array([steady[r[np.argmin(steady[r, 1])]] for r in rows]).reshape(-1, 2)


def _slopes(life: Array) -> Array:
    """MB a second between all pairs of samples."""
    i, j = np.triu_indices(len(life), 1)
    return (life[j, 1] - life[i, 1]) / (life[j, 0] - life[i, 0])
