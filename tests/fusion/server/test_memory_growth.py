# SPDX-License-Identifier: BSD-3-Clause
"""The measure of growing memory that the benchmarks `chaos` and `fuzz` use."""

import numpy as np
import pytest

from camera_node.foundation.arrays import Array
from tests.benchmarks.faults.memory import MAX_MB_PER_MIN, SAMPLE_S, WARM_UP_S, growth

FILLED_MB, BUFFER_MB, NOISE_MB = 40.0, 20.0, 0.2


def life(minutes: float, mb_per_min: float, seed: int) -> Array:
    """Caches fill during the warm-up, buffers come and go, and some memory leaks."""
    rng = np.random.default_rng(seed)
    age_s = np.arange(0, 60 * minutes, 1.0)
    filled = FILLED_MB * np.minimum(1, age_s / WARM_UP_S)
    buffers = BUFFER_MB * (rng.random(len(age_s)) < 0.5) + NOISE_MB * rng.random(len(age_s))
    return np.column_stack([age_s, 60 + filled + buffers + mb_per_min * age_s / 60])


@pytest.mark.parametrize("mb_per_min", [0.0, 0.3, 0.7, 3.0])
def test_a_leak_is_measured_over_several_lives(mb_per_min: float):
    """Programs that are killed every few minutes; neither warm-up nor buffers count."""
    result = growth([life(minutes, mb_per_min, k) for k, minutes in enumerate((3, 5, 1, 4, 6))])
    assert result is not None
    assert result.low <= mb_per_min <= result.high
    steps = (NOISE_MB + BUFFER_MB * 0.5**SAMPLE_S) / 2  # largest error of a slope over two minutes
    assert abs(result.mb_per_min - mb_per_min) < steps
    assert result.is_excessive == (mb_per_min > MAX_MB_PER_MIN)


def test_short_lives_have_no_growth():
    """They contain little besides the warm-up."""
    assert growth([life(minutes, 5.0, k) for k, minutes in enumerate((1, 3, 2))]) is None
    assert growth([]) is None
