# SPDX-License-Identifier: BSD-3-Clause
"""Markers that are not where their robots were measured."""

from itertools import product

import numpy as np
import pytest
from scipy.stats import chi2

from fusion.model.marker_places import PLACE_M, frame_covariance, motions
from fusion.model.observations import MarkerTable
from fusion.model.robots import Robot
from fusion.rig_graph.robot_shapes import RARER, RARER_ONE, TOLERANCES_M, RobotShapes, posterior

FOUR = np.array([[0.08, 0.05, 0.0], [-0.07, 0.06, 0.0], [-0.06, -0.08, 0.01], [0.05, -0.07, 0.0]])
FIVE = np.concatenate([FOUR, [[0.01, 0.02, 0.05]]])
NOISE_M = 1e-4  # of a coordinate in a window
SEEDS = 40
CHANCE = chi2.ppf(1 - 1e-3, 6 * SEEDS) / (6 * SEEDS)  # of the mean squared error over its claim


def window(places: np.ndarray, off: np.ndarray, rng: np.random.Generator | None = None):
    """What images show of displacements (m, 3), with noise if `rng` is given: not the motions that they have in
    common."""
    M = motions(places)
    H = (np.eye(len(M)) - M @ np.linalg.pinv(M)) / NOISE_M**2
    noise = 0.0 if rng is None else NOISE_M * rng.standard_normal(len(M))
    return H, H @ (off.ravel() + noise)


def table(places: np.ndarray) -> MarkerTable:
    return MarkerTable.of([Robot(diameter_m=0.06, markers=tuple(map(tuple, places.tolist())))])


def learned(places: np.ndarray, off: np.ndarray, windows: int, rng: np.random.Generator | None = None):
    """The table and the shapes after windows of a robot whose markers are off."""
    markers = table(places)
    shapes = RobotShapes(markers)
    for _ in range(windows):
        used = markers.position.T
        learn(shapes, {0: window(used, places + off - used, rng)})
    return markers, shapes


def learn(shapes: RobotShapes, windows: dict) -> bool:
    return shapes.use(shapes.learned(windows))


def frame_error(places: np.ndarray, off: np.ndarray, markers: MarkerTable) -> float:
    """Squared error of the robot's frame over its claim, by 6."""
    error = np.linalg.pinv(motions(places)) @ (places + off - markers.position.T).ravel()
    return float(error @ np.linalg.solve(markers.frame[0], error)) / 6


def one_off(places: np.ndarray, off_m: float, rng: np.random.Generator) -> np.ndarray:
    """One marker is off in the plane of its robot."""
    off, angle = np.zeros_like(places), rng.uniform(0, 2 * np.pi)
    off[rng.integers(len(places))] = off_m * np.array([np.cos(angle), np.sin(angle), 0.0])
    return off


@pytest.mark.parametrize("marker", range(len(FIVE)))
@pytest.mark.parametrize("off_m", [0.003, 0.02])
def test_a_displaced_marker_is_used_where_windows_show_it(marker: int, off_m: float):
    """Without noise: to what the tolerance of the others leaves, and to second order of the motion that displacements
    have in common, 0.04 rad squared of 0.1 m. A small one may be several small ones, which is claimed."""
    off = np.zeros_like(FIVE)
    off[marker] = off_m * np.array([0.8, -0.6, 0.0])
    markers, shapes = learned(FIVE, off, 20)
    assert list(shapes.displaced_m) == [0]
    assert frame_error(FIVE, off, markers) < 1.0
    if off_m > 0.01:
        np.testing.assert_allclose(markers.position.T - FIVE, off, atol=PLACE_M)
        assert shapes.displaced_m[0] == pytest.approx(off_m, abs=PLACE_M)


@pytest.mark.parametrize("places", [FOUR, FIVE], ids=["four", "five"])
@pytest.mark.parametrize("sigma_m", [PLACE_M, 1e-3, 3e-3])
def test_claims_contain_the_errors_of_all_places(places: np.ndarray, sigma_m: float):
    """Images don't show the frame of a robot, but how far its places are from what is declared. Chi-square over many
    robots that are measured as well as usual; worse ones are believed as far as a few distances show them, and then
    below 2, as `tests.benchmarks.trust` asks."""
    squared = []
    for seed in range(SEEDS):
        rng = np.random.default_rng(seed)
        off = sigma_m * rng.standard_normal(places.shape)
        squared.append(frame_error(places, off, learned(places, off, 1, rng)[0]))
    assert 0.25 < np.mean(squared) < (CHANCE if sigma_m == PLACE_M else 2.0)


@pytest.mark.parametrize("n", [3, 4, 5])
@pytest.mark.parametrize("off_m", [0.002, 0.005, 0.02])
def test_claims_contain_the_error_of_one_place(n: int, off_m: float):
    """Three markers may not show which of them it is, if the rig may have another size: all are claimed."""
    places, squared = FIVE[:n], []
    for seed in range(SEEDS):
        rng = np.random.default_rng(seed)
        off = one_off(places, off_m, rng)
        squared.append(frame_error(places, off, learned(places, off, 1, rng)[0]))
    assert np.mean(squared) < CHANCE


def test_robots_as_well_measured_as_stated_are_not_reported():
    reported = 0
    for seed in range(SEEDS):
        rng = np.random.default_rng(seed)
        off = PLACE_M * rng.standard_normal(FOUR.shape)
        reported += bool(learned(FOUR, off, 1, rng)[1].displaced_m)
    assert reported == 0


def test_a_robot_of_another_size_stays_as_it_is():
    """The rig may have another size: one robot does not show which."""
    markers, shapes = learned(FOUR, 0.02 * FOUR, 20)
    np.testing.assert_allclose(markers.position.T, FOUR, atol=PLACE_M / 3)
    assert not shapes.displaced_m


def test_windows_add_and_two_that_contradict_them_replace_them():
    """Of a marker that is displaced between two windows, the new place is used once a second window shows it. What one
    window shows, such as two roundels under exchanged numbers, changes nothing."""
    rng = np.random.default_rng(0)
    off = one_off(FIVE, 0.01, rng)
    markers = table(FIVE)
    shapes = RobotShapes(markers)
    for _ in range(50):
        learn(shapes, {0: window(markers.position.T, FIVE - markers.position.T)})
    assert not shapes.displaced_m
    np.testing.assert_allclose(markers.position.T, FIVE, atol=1e-9)
    exchanged = FIVE[[1, 0, 2, 3, 4]] - FIVE
    for shown in (exchanged, 0 * off, off):
        assert not learn(shapes, {0: window(FIVE, shown)})
        np.testing.assert_allclose(markers.position.T, FIVE, atol=1e-9)
    assert learn(shapes, {0: window(FIVE, off)})
    np.testing.assert_allclose(markers.position.T - FIVE, off, atol=PLACE_M)
    shapes.forget()
    assert not learn(shapes, {0: window(markers.position.T, FIVE - markers.position.T)})
    assert shapes.displaced_m
    assert learn(shapes, {0: window(markers.position.T, FIVE - markers.position.T)})
    assert not shapes.displaced_m


def test_a_common_motion_of_all_markers_is_no_shape():
    """However well a window shows it, by the directions of prints: one of swapped frames turned a robot by 12 mm."""
    M = motions(FOUR)
    shown = M @ M.T / NOISE_M**2
    H, y = window(FOUR, np.zeros_like(FOUR))
    markers = table(FOUR)
    turned = H + shown, y + shown @ M @ [0.05, 0.0, 0.0, 0.0, 0.0, 0.0]
    np.testing.assert_allclose(RobotShapes(markers).learned({0: turned})[0].off, 0.0, atol=1e-5)


def test_the_posterior_is_the_mixture_of_all_tolerances():
    """Computed by each covariance of the places, as the windows' marginal likelihood has it."""
    H, y = window(FOUR, one_off(FOUR, 0.001, np.random.default_rng(1)), np.random.default_rng(2))
    means, covariances, logs = [], [], []
    for all_m, one_m in product(TOLERANCES_M, repeat=2):
        for marker in range(len(FOUR)) if one_m > all_m else [0] if one_m == all_m else []:
            tolerance = np.full((len(FOUR), 3), all_m)
            tolerance[marker] = one_m
            S = np.diag(tolerance.ravel() ** 2)
            covariances.append(np.linalg.inv(H + np.linalg.inv(S)))
            means.append(covariances[-1] @ y)
            rarer = RARER_ONE * np.log(one_m / PLACE_M) if one_m > all_m else 0.0
            prior = -RARER * np.log(all_m / PLACE_M) - rarer
            logs.append(prior - np.linalg.slogdet(np.eye(len(H)) + S @ H)[1] / 2 + y @ means[-1] / 2)
    shares = np.exp(np.array(logs) - max(logs))
    shares /= shares.sum()
    assert np.sort(shares)[-2] > 0.01  # several explanations
    expected = shares @ np.array(means)
    off = np.array(means) - expected
    covariance = np.einsum("k,kij->ij", shares, np.array(covariances) + off[:, :, None] * off[:, None])
    found = posterior(H, y)
    np.testing.assert_allclose(found[0].ravel(), expected, atol=1e-9)
    np.testing.assert_allclose(found[1], covariance, rtol=1e-4, atol=1e-6 * np.abs(covariance).max())


def test_what_no_window_shows_is_claimed_as_declared():
    """The frame has the tolerance of the places over the root of their number."""
    nothing = np.zeros((12, 12)), np.zeros(12)
    mean, covariance = posterior(*nothing)
    np.testing.assert_array_equal(mean, 0.0)
    assert PLACE_M < covariance[0, 0] ** 0.5 < 1e-3
    np.testing.assert_allclose(covariance, covariance[0, 0] * np.eye(12), atol=1e-12)
    covariance = PLACE_M**2 * np.eye(12)
    frame = frame_covariance(FOUR - FOUR.mean(0), covariance)
    np.testing.assert_allclose(np.sqrt(np.diag(frame)[3:]), PLACE_M / 2, rtol=1e-9)
    np.testing.assert_allclose(table(FOUR).frame[0], frame_covariance(FOUR, covariance), atol=1e-20)
    np.testing.assert_array_equal(table(FOUR[:1] * 0).frame, 0.0)


def test_the_frame_moves_with_the_places():
    motion = np.array([1e-3, -2e-3, 5e-4, 1e-3, 2e-3, -1e-3])
    displaced = motions(FOUR) @ motion
    expected = np.cross(motion[:3], FOUR) + motion[3:]
    np.testing.assert_allclose(displaced.reshape(-1, 3), expected, atol=1e-12)
    np.testing.assert_allclose(
        frame_covariance(FOUR, np.outer(displaced, displaced)), np.outer(motion, motion), atol=1e-15
    )
