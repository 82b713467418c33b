# SPDX-License-Identifier: BSD-3-Clause
"""Clocks that depart are found with offset and rate within their claims; good clocks are left alone."""

import numpy as np
import pytest

from fusion.rig_graph.clock_walk import ClockWalk, Departure
from fusion.rig_graph.hypotheses import CAUSES, DOUBTED, ERRORS, Fit, Hypothesis, about_clocks

WINDOW_S, SIGMA_S = 2.4, 1e-4  # between windows, and of an offset in one
START_NS = 10**18


def first_departure(rates: list[float], seed: int, windows: int = 25) -> Departure | None:
    """Of clocks that drift at these rates, each window showing the differences of their offsets with noise."""
    rng, n = np.random.default_rng(seed), len(rates)
    walk = ClockWalk(n)
    for k in range(windows):
        offsets = np.array(rates) * k * WINDOW_S
        relative = np.eye(n) - 1 / n
        M = relative / SIGMA_S**2
        y = relative @ (offsets + SIGMA_S * rng.normal(size=n)) / SIGMA_S**2
        walk.update(START_NS + round(k * WINDOW_S * 1e9), M, y)
        found = walk.take_departure()
        if found is not None:
            return found
    return None


@pytest.mark.parametrize("ppm", [50.0, -200.0, 2000.0])
@pytest.mark.parametrize("n_cameras", [3, 4, 8])
def test_a_clock_that_drifts_is_found_with_its_offset(ppm: float, n_cameras: int):
    deviations = []
    for seed in range(20):
        found = first_departure([ppm * 1e-6, *[0.0] * (n_cameras - 1)], seed)
        assert found is not None
        assert found.camera == 0
        deviations.append((found.offset_s - ppm * 1e-6 * (found.t_ns - START_NS) * 1e-9) / found.sigma_s)
    assert np.mean(np.square(deviations)) < 2.3  # chi-square with 20 degrees of freedom, one in a thousand


@pytest.mark.parametrize("n_cameras", [2, 3, 4, 8])
def test_good_clocks_are_left_alone(n_cameras: int):
    assert not any(first_departure([0.0] * n_cameras, seed) for seed in range(20))


def test_two_clocks_do_not_show_which_one_departs():
    assert first_departure([2e-4, 0.0], 1) is None


def test_a_jump_that_is_known_to_be_possible_is_of_that_camera():
    walk = ClockWalk(4)
    walk.jump(2, 0.02)
    offsets, relative = np.array([0.0, 0.0, 0.025, 0.0]), np.eye(4) - 0.25
    walk.update(10**9, relative / SIGMA_S**2, relative @ offsets / SIGMA_S**2)
    found = walk.take_departure()
    assert found is not None
    assert found.camera == 2
    assert found.at(10**9) == pytest.approx(0.025, abs=3 * found.sigma_s)
    assert np.abs(walk.x[::2]).max() < 5e-4


def test_offsets_are_those_of_the_whole_system_with_free_poses():
    rng, n = np.random.default_rng(4), 3
    A = rng.normal(size=(60, n * ERRORS))
    errors, truth = 0.1 * rng.normal(size=n * ERRORS), rng.normal(size=n * ERRORS)
    H, g = A.T @ A, A.T @ (A @ (truth - errors))
    empty = np.zeros((0, 0))
    hypothesis = Hypothesis.of(None, (), n)
    reduced = np.column_stack([H, g])
    best = Fit(hypothesis, 0.0, errors.reshape(n, ERRORS), empty, reduced, empty, np.zeros(60))
    M, y = about_clocks(best, np.eye(n * ERRORS))
    is_clock = np.arange(n * ERRORS) % ERRORS == CAUSES["clock"].start
    weak = np.where(is_clock, 0.0, DOUBTED**-2)
    whole = errors + np.linalg.solve(H + np.diag(weak), g - weak * errors)
    np.testing.assert_allclose(np.linalg.solve(M, y), whole[is_clock], rtol=1e-9)
    np.testing.assert_allclose(
        np.linalg.inv(M), np.linalg.inv(H + np.diag(weak))[np.ix_(is_clock, is_clock)], rtol=1e-9
    )
