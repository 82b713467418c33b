# SPDX-License-Identifier: BSD-3-Clause
"""Labelings of a view found by the native core, compared with all subsets of its pairs."""

from collections.abc import Iterator
from itertools import combinations

import numpy as np
import pytest

from camera_node.foundation.arrays import Array, Index
from fusion import _core

pytestmark = pytest.mark.computed

NO_LIMIT = 1 << 20
VIEWS, PAIRS = 40, 9  # 512 subsets of each


def _views() -> tuple[Index, Index, Index, Array, Index, Array]:
    rng = np.random.default_rng(3)
    size = rng.integers(0, PAIRS + 1, VIEWS)
    first = np.cumsum([0, *size])
    marker = np.concatenate([np.sort(rng.integers(4, size=n)) for n in size])
    detection, cost = rng.integers(4, size=first[-1]), rng.normal(-2, 4, first[-1])
    return first, marker, detection, cost, rng.integers(0, 3, VIEWS), rng.normal(-2, 4, VIEWS)


def _subsets(
    marker: Index, detection: Index, cost: Array, least: int, most: float
) -> Iterator[tuple[int, ...]]:
    for n in range(least, len(cost) + 1):
        for chosen in combinations(range(len(cost)), n):
            rows = list(chosen)
            alone = len(set(marker[rows])) == n and len(set(detection[rows])) == n
            if alone and cost[rows].sum() < most:
                yield chosen


def test_all_labelings_are_found():
    first, marker, detection, cost, least, most = _views()
    view, total, number, pair = _core.labelings(
        first, marker, detection, cost, least, most, NO_LIMIT, NO_LIMIT
    )
    found = [tuple(pair[number == k] - first[view[k]]) for k in range(len(view))]
    assert len(found) > 5 * VIEWS
    for v in range(VIEWS):
        rows = slice(first[v], first[v + 1])
        expected = sorted(_subsets(marker[rows], detection[rows], cost[rows], least[v], most[v]))
        assert sorted(one for one, of in zip(found, view, strict=True) if of == v) == expected
    sums = np.bincount(number, cost[pair], len(view))
    np.testing.assert_allclose(total, sums, atol=1e-12)


@pytest.mark.parametrize("steps", [0, 5, 50])
def test_the_search_is_bounded(steps: int):
    views = _views()
    whole = _core.labelings(*views, NO_LIMIT, NO_LIMIT)[0]
    by_steps = _core.labelings(*views, steps, NO_LIMIT)[0]
    assert np.bincount(by_steps, minlength=VIEWS).max() <= steps
    by_count = _core.labelings(*views, NO_LIMIT, 3)[0]
    counts = np.bincount(whole, minlength=VIEWS)
    assert np.array_equal(np.bincount(by_count, minlength=VIEWS), np.minimum(counts, 3))


def test_views_that_do_not_divide_the_pairs_are_refused():
    first, marker, detection, cost, least, most = _views()
    for wrong in (first[::-1].copy(), first + 1, np.maximum(first - 1, 0)):
        with pytest.raises(IndexError, match="views do not divide the pairs"):
            _core.labelings(wrong, marker, detection, cost, least, most, NO_LIMIT, NO_LIMIT)
