# SPDX-License-Identifier: BSD-3-Clause
"""Intersections of rays of different cameras: the native core against all pairs in NumPy."""

import numpy as np
import pytest

from fusion._core import MIN_PARALLAX, Viewpoints, densest_ranges, ray_pairs
from tests.fusion.synthetic import ring

F, EACH, SIZES = 5, 40, np.array([0.1, 0.16])


def scene(seed: int) -> tuple[np.ndarray, ...]:
    """Rays of five frames, two of them of one camera, to points that some frames see, and rays that point upwards.

    Each ray has its own time, as rolling shutters have.
    """
    random = np.random.default_rng(seed)
    camera = np.array([0, 1, 1, 2, 3])
    centre = np.array([c.matrix()[:3, 3] for c in ring().values()])
    frame = np.repeat(np.arange(F), EACH)
    points = random.uniform(-0.6, 0.6, (2 * EACH, 3))[random.integers(0, 2 * EACH, F * EACH)]
    points[random.random(F * EACH) < 0.1] = 0, 0, 9
    to = points + random.normal(scale=2e-3, size=points.shape) - centre[camera[frame]]
    range_m = np.linalg.norm(to, axis=1)
    ranges = range_m[:, None, None] * random.uniform(0.9, 1.1, (F * EACH, 1, 1)) * SIZES[:, None] / SIZES[0]
    ranges = ranges * [0.8, 1.2]
    ranges[random.random(F * EACH) < 0.1] = 0, 6  # of unknown size
    reach = random.uniform(1e-3, 2e-3, F * EACH)
    moved = 2.0 * (random.uniform(-0.01, 0.01, F)[frame] + random.uniform(-0.005, 0.005, F * EACH))
    return camera, centre, frame, to / range_m[:, None], reach, moved, ranges


def all_pairs(camera, centre, frame, d, reach, moved, ranges) -> tuple[np.ndarray, ...]:
    """(N, N) of all pairs: whether they can intersect, miss, its limit, range on the first, and parallax."""
    o = centre[camera[frame]]
    w, b = o[:, None] - o, d @ d.T
    wi, wj = np.einsum("ijc,ic->ij", w, d), np.einsum("ijc,jc->ij", w, d)
    with np.errstate(divide="ignore", invalid="ignore"):
        parallax = 1 - b * b
        s, t = (b * wj - wi) / parallax, (wj - b * wi) / parallax
        between = w + s[..., None] * d[:, None] - t[..., None] * d
        limit = np.hypot(reach[:, None] * s, reach * t) + np.abs(moved[:, None] - moved)
    low, high = ranges[..., 0], ranges[..., 1]
    suits = ((low[:, None] < s[..., None]) & (s[..., None] < high[:, None])).any(2)
    suits &= ((low[None] < t[..., None]) & (t[..., None] < high[None])).any(2)
    suits &= (camera[frame][:, None] != camera[frame]) & (parallax > MIN_PARALLAX) & (s > 0) & (t > 0)
    return suits, np.sqrt((between**2).sum(2)), limit, s, parallax


def expected(*given) -> np.ndarray:
    """(N,) ranges from all pairs."""
    suits, miss, limit, s, parallax = all_pairs(*given)
    near = suits & (miss < limit)
    return np.array(
        [densest(s[k, near[k]], limit[k, near[k]] / np.sqrt(parallax[k, near[k]])) for k in range(len(near))]
    )


def densest(ranges: np.ndarray, reach: np.ndarray) -> float:
    """The mean of the ranges that agree with the one that has most agreement."""
    if not len(ranges):
        return np.nan
    ranges, reach = ranges[np.argsort(ranges)], reach[np.argsort(ranges)]
    agree = (ranges >= (ranges - reach)[:, None]) & (ranges < (ranges + reach)[:, None])
    best = np.argmax(agree.sum(1) - reach / (1 + reach))
    return float(ranges[agree[best]].mean())


@pytest.mark.parametrize("seed", range(5))
def test_ranges_equal_those_of_all_pairs(seed: int):
    """Rounding differs by 1e-12 of a range, divided by the parallax of 0.003."""
    given = scene(seed)
    found = densest_ranges(Viewpoints(*given[:2]), *given[2:])
    assert 0.5 < np.isfinite(found).mean() < 1
    np.testing.assert_allclose(found, expected(*given), rtol=1e-9)


@pytest.mark.parametrize("most", [0.5, 4.0])
def test_pairs_equal_those_of_all_rays(most: float):
    given = scene(1)
    suits, miss, limit, s, _ = all_pairs(*given)
    i, j = np.nonzero(np.triu(suits & (miss < most * limit)))
    camera, centre, frame, d, reach, moved, ranges = given
    rows, found = ray_pairs(Viewpoints(camera, centre), frame, d, reach, moved, ranges, most)
    (first, second), (found_miss, range_m) = rows, found
    order = np.lexsort((second, first))
    np.testing.assert_array_equal(np.stack([first, second])[:, order], [i, j])
    np.testing.assert_allclose(found_miss[order], miss[i, j] / limit[i, j], rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(range_m[order], s[i, j], rtol=1e-9)


def test_nearly_parallel_rays_do_not_intersect():
    """Two rays cross at a distance of one metre, at angles of 20 and 2 degrees."""
    ranges = np.tile([0.0, 50.0], (2, 1, 1))

    def crossing(degrees: float) -> np.ndarray:
        aside = np.tan(np.radians(degrees))
        d = np.array([[0.0, 0.0, 1.0], [-aside, 0.0, 1.0]]) / [[1.0], [np.hypot(aside, 1)]]
        centres, one = np.array([[0.0, 0.0, 0.0], [aside, 0.0, 0.0]]), np.arange(2)
        return densest_ranges(Viewpoints(one, centres), one, d, np.full(2, 1e-3), np.zeros(2), ranges)

    assert np.isnan(crossing(2.0)).all()
    np.testing.assert_allclose(crossing(20.0), [1, 1 / np.cos(np.radians(20))])
