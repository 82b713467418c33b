# SPDX-License-Identifier: BSD-3-Clause
"""Points of unknown size that two cameras see."""

import numpy as np
import pytest

from fusion.tracking.grouping.two_views import _marginals
from tests.benchmarks.fusion_grouping import SCENES, SIDE_BY_SIDE, Scene, score


@pytest.mark.parametrize(
    ("name", "recall_of_two"),
    [
        ("34 points, 2 cameras 1 m apart", 0.9),
        ("34 points, 2 cameras around", 0.95),
        ("34 points, 3 cameras around, poses off", 0.95),
        ("130 points, 4 cameras 0.6 m apart", 0.9),
    ],
)
def test_points_in_two_views_are_found(name: str, recall_of_two: float):
    """With a gate of fixed width, 0.64, 0.93, 0.68 and 0.19 of them were found, with a precision down to 0.80."""
    got = score(SCENES[name], range(6))
    assert got.of_two >= 30
    assert got.recall_of_two >= recall_of_two
    assert got.precision >= 0.99


def test_cameras_side_by_side_are_grouped_precisely():
    """All epipolar lines are parallel here, so that many pairs of rays intersect by chance."""
    got = score(SIDE_BY_SIDE, range(3))
    assert got.precision >= 0.99
    assert got.recall >= 0.9


def test_false_roundels_make_no_points():
    """Of 30 in each of two cameras, 3 pairs of rays pass each other within the noise by chance."""
    got = score(SCENES["30 false roundels in 2 cameras"], range(20))
    assert got.markers <= 2  # of 20 arenas


def test_more_noise_makes_fewer_points_not_wrong_ones():
    """Poses that are off by 3 px: the misses are larger than any allowance, and few pairs are probable."""
    got = score(Scene(baseline_m=1.0, turned_rad=3e-3), range(6))
    assert got.correct >= 0.95 * got.markers


@pytest.mark.parametrize("seed", range(4))
def test_probabilities_of_pairs_are_those_of_all_sets_of_pairs(seed: int):
    """On a graph without cycles belief propagation is exact: compared with the sum over all sets of pairs."""
    rng = np.random.default_rng(seed)
    n = 8
    pairs = np.array([[rng.integers(0, k), k] for k in range(1, n)]).T  # a random tree
    ratios = np.exp(rng.normal(0, 2, pairs.shape[1]))
    total, each = 0.0, np.zeros(len(ratios))
    for chosen in range(1 << len(ratios)):
        rows = [k for k in range(len(ratios)) if chosen >> k & 1]
        if len(np.unique(pairs[:, rows])) == 2 * len(rows):
            weight = float(np.prod(ratios[rows]))
            total += weight
            each[rows] += weight
    messages = np.full((2, len(ratios)), 0.5)
    for _ in range(7):  # more passes than edges on any path
        messages = _marginals(pairs, ratios, messages, n)[1]
    got = _marginals(pairs, ratios, messages, n)[0]
    np.testing.assert_allclose(got, each / total, atol=1e-6)
